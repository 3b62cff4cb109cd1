// What happened to the road: as features to draw, as a list, and in words.

import { clock } from "./bar.js";
import { lengthOf } from "./geometry.js";
import { categoryName } from "./paint.js";

/** Events that are listed; all in view are drawn. */
const MOST_LISTED = 8;
/** What is asked for: what happened to the road, not to names. */
export const PATH = "events?kind=appeared,vanished,moved,repainted&limit=500";

const SAYS = {
  appeared: "Drives before saw no line here; later ones do.",
  vanished: "Drives that had this stretch in view see no line any more. It is drawn where it was.",
  moved: "The line lies elsewhere than before. It is drawn where it is now.",
  repainted: "The line lies where it was, painted otherwise.",
};

/** What is believed of what was told. */
export const believed = ({ features }) => features.filter(({ properties, geometry }) => geometry && !properties.withdrawn);

/** Each event as a line, and a mark in its middle that is seen from afar. */
export function drawn(events) {
  return events.flatMap(({ id, geometry, properties: { kind, probability, lane } }) => {
    const properties = { event: id, lane, kind, probability };
    const middle = geometry.coordinates[Math.floor(geometry.coordinates.length / 2)];
    return [
      { type: "Feature", properties, geometry },
      { type: "Feature", properties, geometry: { type: "Point", coordinates: middle } },
    ];
  });
}

/** The line to which it happened, and what did. */
export const title = ({ properties: { category, category_before, kind } }) =>
  category_before === undefined ? `${categoryName(category)} ${kind}` : `${categoryName(category_before)} now ${categoryName(category)}`;

/** How sure it is. */
export const sureness = ({ properties: { probability } }) => (probability > 0.995 ? ">99 %" : `${Math.round(probability * 100)} %`);

/** When a drive noticed it. */
export const noticed = (event) => new Date(time(event)).toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric" });

/** What is known of it, as pairs of names and values. */
export function figures(event, metres) {
  const { properties, geometry } = event;
  return [
    ["probability", sureness(event)],
    ["length", `${lengthOf(geometry).toFixed(0)} m`],
    ...(properties.moved_m === undefined ? [["drives", properties.drives]] : [["moved by", metres(properties.moved_m)]]),
    ["noticed", noticed(event)],
    ["told", clock(Date.parse(properties.told_at))],
    ["cell version", properties.version],
  ];
}

/** What happened, and how it came to be known. */
export const says = (event) => `${SAYS[event.properties.kind] ?? ""} It is believed since the drive of ${noticed(event)}.`;

/** The newest events in view, as a list; `choose(event)` is called with the one that is chosen. */
export function list(events, choose) {
  const newest = events.toSorted((one, other) => time(other) - time(one)).slice(0, MOST_LISTED);
  return newest.map((event) => {
    const row = document.createElement("li");
    row.innerHTML = `<button type="button" class="choose"><span class="dash-swatch"></span><span class="name"></span><span class="sure"></span><span class="when"></span></button>`;
    const [button] = row.children;
    const [swatch, name, sure, when] = button.children;
    swatch.style.borderColor = `var(--${event.properties.kind})`;
    if (event.properties.kind === "vanished") swatch.dataset.dashed = "";
    name.textContent = title(event);
    sure.textContent = sureness(event);
    when.textContent = noticed(event);
    button.addEventListener("click", () => choose(event));
    return row;
  });
}

const time = ({ properties }) => Date.parse(properties.noticed ?? properties.told_at);
