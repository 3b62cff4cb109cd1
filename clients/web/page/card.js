// The card of a line: what is known of it, how it came to be, and what it goes on in.

import { clock } from "./bar.js";
import { lengthOf } from "./geometry.js";
import * as event from "./happened.js";
import { categoryName } from "./paint.js";

/** The categories in the order of their probabilities in `category_posterior`. */
const CATEGORIES = [
  "unknown", "white_dashed", "white_solid", "double_white_dashed", "double_white_solid", "white_left_dashed_right_solid",
  "white_left_solid_right_dashed", "yellow_dashed", "yellow_solid", "double_yellow_dashed", "double_yellow_solid",
  "yellow_left_dashed_right_solid", "yellow_left_solid_right_dashed", "left_curb", "right_curb",
];
/** Categories that are shown, the most probable ones. */
const MOST_BARS = 4;
/** A line that moved by less did not move for the eye. */
const MOVED_M = 0.05;
/** Entries of the story. */
const MOST_EVENTS = 6;

/** Names that are shown, the newest. */
const MOST_NAMES = 4;
const WAS = { renamed: "had the name", merged: "took in", split: "parted from" };
const IS = { renamed: "has the name", merged: "is part of", split: "parted into" };

const box = document.getElementById("card");

export class Card {
  #server;
  #on;
  #shown;

  /** `on.close()` is called as it is closed, `on.look(feature)` to fly to the line, `on.line(id)` to go to another one. */
  constructor(server, on) {
    this.#server = server;
    this.#on = on;
  }

  /** The feature id of the line that is shown. */
  get id() {
    return this.#shown;
  }

  /** Whether it is shown, of a line or of what happened. */
  get isOpen() {
    return !box.hidden;
  }

  close() {
    this.#shown = undefined;
    box.hidden = true;
  }

  /** Shows the line of a feature id, `cell.lane.part`; says whether there is one. */
  async show(id, { focus = false } = {}) {
    this.#shown = id;
    const [cell, lane] = id.split(".");
    const path = `cells/${cell}/lanes`;
    const [lines, history] = await Promise.all([
      this.#server.json(`${path}.geojson`),
      this.#server.json(`${path}/${encodeURIComponent(lane)}/history`).catch(() => undefined),
    ]);
    if (this.#shown !== id) return undefined;
    const feature = lines.features.find((each) => each.id === id)
      ?? lines.features.find((each) => each.properties.lane === lane);
    if (!feature && !history) {
      this.close();
      return undefined;
    }
    this.#draw(feature, history, id);
    if (focus) box.querySelector(".close").focus();
    return feature;
  }

  /** Tells what happened to a stretch of road. */
  tell(happened) {
    const { cell, lane } = happened.properties;
    // It is no line: nothing of it is drawn anew when its cell changes.
    this.#shown = undefined;
    box.hidden = false;
    const facts = event.figures(happened, metres).map(([name, value]) => figure(name, value));
    box.replaceChildren(
      this.#header(event.title(happened)),
      make("p", { className: "name fine" }, [make("code", { textContent: lane }), ` · cell ${cell}`]),
      make("dl", { className: "figures" }, facts),
      make("p", { textContent: event.says(happened) }),
      make("div", { className: "row" }, [
        make("button", { type: "button", textContent: "Show whole", onclick: () => this.#on.look(happened) }),
        make("button", { type: "button", textContent: "The line's history", onclick: () => this.#on.line(`${cell}.${lane}.0`) }),
      ]),
    );
    box.scrollTop = 0;
  }

  #header(title) {
    return make("header", {}, [
      make("h2", { textContent: title }),
      make("button", { type: "button", className: "close", ariaLabel: "Close (Esc)", textContent: "×", onclick: this.#on.close }),
    ]);
  }

  #draw(feature, history, id) {
    const scrolled = box.hidden ? 0 : box.scrollTop;
    box.hidden = false;
    const known = feature?.properties;
    const last = history?.versions.findLast((entry) => entry.category);
    const header = this.#header(categoryName(known?.category ?? last?.category ?? "line"));
    const [cell, lane, part] = id.split(".");
    const name = make("p", { className: "name fine" }, [
      make("code", { textContent: lane }), ` · cell ${cell}${part === "0" ? "" : ` · piece ${part}`}`,
    ]);
    box.replaceChildren(header, name, ...(known ? this.#figures(feature) : [gone(last)]), ...this.#names(cell, history), ...story(history));
    box.scrollTop = scrolled;
  }

  /** The lines that it was, and those that it is now. */
  #names(cell, history) {
    const rows = [
      ...(history?.came_from ?? []).map(({ kind, lane, at }) => [at, WAS[kind], [lane]]),
      ...(history?.became ?? []).map(({ kind, lanes, at }) => [at, IS[kind], lanes.filter((name) => name !== history.lane)]),
    ].filter(([, says, lanes]) => says && lanes.length > 0).slice(-MOST_NAMES).reverse();
    if (rows.length === 0) return [];
    const link = (lane) => make("button", {
      type: "button", className: "lane", textContent: shortName(lane), title: lane, onclick: () => this.#on.line(`${cell}.${lane}.0`),
    });
    return [make("h3", { textContent: "Its names" }), make("ul", { className: "events names" }, rows.map(([at, says, lanes]) => make("li", {}, [
      make("time", { dateTime: at, textContent: clock(Date.parse(at)) }), make("span", {}, [`${says} `, ...lanes.map(link)]),
    ])))];
  }

  #figures(feature) {
    const known = feature.properties;
    const figures = make("dl", { className: "figures" }, [
      figure("existence", percent(known.existence)),
      figure("sigma across", metres(known.lateral_sigma_m)),
      figure("sigma height", metres(known.height_sigma_m)),
      figure("drives", known.drives),
      figure("frames", known.observations.toLocaleString("en")),
      figure("length", `${lengthOf(feature.geometry).toFixed(0)} m`),
      figure("first seen", when(known.first_seen)),
      figure("last seen", when(known.last_seen)),
      figure("all confirmed", when(known.confirmed)),
    ]);
    const onward = [["Comes from", known.comes_from], ["Goes on", known.continues_in]].filter(([, id]) => id);
    const buttons = make("div", { className: "row" }, [
      make("button", { type: "button", textContent: "Show whole", onclick: () => this.#on.look(feature) }),
      ...onward.map(([textContent, id]) => make("button", { type: "button", textContent, onclick: () => this.#on.line(id) })),
    ]);
    return [figures, make("h3", { textContent: "What it is" }), bars(known.category_posterior), buttons];
  }
}

function gone(last) {
  const text = last ? `It is no longer in the map. It was ${categoryName(last.category)}, ${Math.round(last.length_m)} m long.`
    : "It is no longer in the map.";
  return make("p", { textContent: text });
}

function figure(name, value, className = "") {
  return make("div", { className }, [make("dt", { textContent: name }), make("dd", { textContent: value })]);
}

/** The most probable categories as bars. */
function bars(posterior) {
  const ranked = posterior.map((share, index) => ({ share, name: categoryName(CATEGORIES[index]) }))
    .filter(({ share }) => share >= 0.005)
    .sort((one, other) => other.share - one.share)
    .slice(0, MOST_BARS);
  const list = make("dl", { className: "bars" });
  for (const { share, name } of ranked) {
    const bar = make("dd", { className: "bar", ariaHidden: "true" }, [make("i")]);
    bar.firstChild.style.width = `${100 * share}%`;
    list.append(make("div", {}, [make("dt", { textContent: name }), bar, make("dd", { textContent: percent(share) })]));
  }
  return list;
}

/** How the line came to be: its sigma over time, and what happened when. */
function story(history) {
  if (!history || history.versions.length === 0) return [];
  const { versions } = history;
  const ofRoad = history.events.filter(({ properties }) => !properties.withdrawn)
    .map((each) => ({ at: each.properties.told_at, text: `${capital(each.properties.kind)}, ${event.sureness(each)} sure` }));
  const events = [...versions.flatMap((entry, index) => happened(entry, versions[index - 1], history.oldest_kept)), ...ofRoad]
    .sort((one, other) => Date.parse(one.at) - Date.parse(other.at));
  const shown = events.reverse().slice(0, MOST_EVENTS);
  const list = make("ul", { className: "events" }, shown.map(({ at, text }) => make("li", {}, [
    make("time", { dateTime: at, textContent: clock(Date.parse(at)) }), make("span", { textContent: text }),
  ])));
  const count = versions.length === 1 ? "1 version" : `${versions.length} versions`;
  return [
    make("h3", { textContent: "How it came to be" }),
    ...chart(versions),
    list,
    make("p", { className: "fine", textContent: `Changed in ${count} of those of its cell that are kept (${history.oldest_kept} to ${history.newest}).` }),
  ];
}

/** What of a version is worth telling. */
function happened(entry, before, oldestKept) {
  const at = entry.at;
  const say = (text) => [{ at, text }];
  if (!before) return say(entry.version > oldestKept ? "Seen for the first time" : `Here already, ${metres(entry.lateral_sigma_m)} sigma`);
  if (!entry.category) return say("Gone from the map");
  if (!before.category) return say("Back in the map");
  const told = [];
  if (entry.category !== before.category) told.push(`${categoryName(before.category)} became ${categoryName(entry.category)}`);
  if (entry.drives > before.drives) told.push(`drive ${entry.drives} saw it`);
  if (entry.moved_m >= MOVED_M) told.push(`moved by ${metres(entry.moved_m)}`);
  if (Math.abs(entry.length_m - before.length_m) >= 5) {
    told.push(entry.length_m > before.length_m ? `grew to ${Math.round(entry.length_m)} m` : `cut to ${Math.round(entry.length_m)} m`);
  }
  return told.length > 0 ? say(capital(told.join(", "))) : [];
}

/** Sigma over time, as a stepped line; drives as marks. */
function chart(versions) {
  const known = versions.filter((entry) => entry.category);
  if (known.length < 3) return [];
  const [width, height, foot] = [312, 92, 16];
  const times = known.map(({ at }) => Date.parse(at));
  const [from, to] = [times[0], Math.max(times.at(-1), times[0] + 1)];
  const most = Math.max(...known.map(({ lateral_sigma_m }) => lateral_sigma_m), 0.01);
  const x = (ms) => (width * (ms - from)) / (to - from);
  const y = (sigma) => height - foot - (height - foot - 14) * (sigma / most);
  const path = known.map(({ lateral_sigma_m }, index) => {
    const [at, level] = [x(times[index]).toFixed(1), y(lateral_sigma_m).toFixed(1)];
    return index === 0 ? `M${at} ${level}` : `H${at}V${level}`;
  }).join("");
  const marks = known.map((entry, index) => {
    const more = index > 0 && entry.drives > known[index - 1].drives;
    return more ? `<path class="mark" d="M${x(times[index]).toFixed(1)} 14V${height - foot}"/>` : "";
  }).join("");
  const figure = document.createElement("div");
  figure.innerHTML = `<svg class="story" viewBox="0 0 ${width} ${height}" role="img">
    ${marks}<path class="line" d="${path}"/>
    <text x="0" y="10">sigma ${metres(most)}</text>
    <text x="0" y="${height - 3}">${clock(from)}</text>
    <text x="${width}" y="${height - 3}" text-anchor="end">${clock(to)}</text></svg>`;
  const last = known.at(-1).lateral_sigma_m;
  figure.firstChild.setAttribute("aria-label", `Sigma across the line from ${metres(known[0].lateral_sigma_m)} to ${metres(last)}; upright marks where another drive saw it`);
  return [figure];
}

/** The name of a line without the start of its oldest drive, which many have in common. */
function shortName(lane) {
  const [, drive, ...rest] = lane.split("-");
  return [drive.slice(0, 6), ...rest].join("-");
}

function make(name, properties = {}, children = []) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function capital(text) {
  return text[0].toUpperCase() + text.slice(1);
}

function percent(share) {
  return share > 0.995 && share < 1 ? ">99 %" : `${Math.round(share * 100)} %`;
}

/** A length as one says it: centimetres below one metre. */
export function metres(value) {
  if (value < 1) return `${value < 0.1 ? (value * 100).toFixed(1) : Math.round(value * 100)} cm`;
  return value < 1000 ? `${value.toFixed(value < 10 ? 2 : 1)} m` : `${(value / 1000).toFixed(2)} km`;
}

function when(text) {
  return clock(Date.parse(text));
}
