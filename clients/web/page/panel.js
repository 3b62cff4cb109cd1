// The panel: the state of the connection, totals, layers with their legend, and drives.

import { list } from "./happened.js";
import { MEASURES, measure } from "./measures.js";
import { LEGEND, swatch } from "./paint.js";
import { colours } from "./theme.js";
import { colourOf } from "./vehicles.js";

/** The choices of a layer, in the order of their keys 1, 2, 3, ... */
export const LAYERS = [
  { id: "paint", name: "Paint", says: "Each line as it is painted on the road" },
  ...MEASURES,
  { id: "change", name: "Change", says: "What happened to the road" },
];

/** Drives in the list at most; more are counted. */
const MOST_DRIVES = 60;
const CONNECTION = { connecting: "connecting", connected: "connected", lost: "no connection", locked: "locked", past: "in the past" };
const element = (id) => document.getElementById(id);

export class Panel {
  #rows = new Map();
  #chosen;
  #on;
  #legend;

  /** `on.layer(id)`, `on.drive(id)` and `on.overview()` are called as they are chosen. */
  constructor(on) {
    this.#on = on;
    const choices = LAYERS.map(({ id, name }, index) => {
      const label = document.createElement("label");
      label.title = `${name} (${index + 1})`;
      label.innerHTML = `<input type="radio" name="layer"><span></span>`;
      Object.assign(label.firstChild, { value: id, checked: id === "paint" });
      label.lastChild.textContent = name;
      return label;
    });
    element("layers").querySelector(".choices").replaceChildren(...choices);
    element("layers").addEventListener("change", ({ target }) => on.layer(target.value));
    element("overview").addEventListener("click", on.overview);
  }

  connection(state) {
    element("connection").dataset.state = state;
    element("connection").textContent = CONNECTION[state];
  }

  /** Shows the totals that are given: kilometres of line, drives, those live, the typical sigma in metres. */
  totals({ km, drives, live, sigma_m }) {
    const show = (name, value) => value !== undefined && element("panel").querySelector(`[data-total="${name}"]`).replaceChildren(...value);
    const unit = (text) => Object.assign(document.createElement("small"), { textContent: text });
    show("km", km === undefined ? undefined : [km < 100 ? km.toFixed(1) : short(km), unit("km")]);
    show("drives", drives === undefined ? undefined : [short(drives)]);
    show("live", live === undefined ? undefined : [short(live)]);
    show("sigma", sigma_m === undefined ? undefined : Number.isFinite(sigma_m) ? [`${Math.round(sigma_m * 100)}`, unit("cm")] : ["–"]);
  }

  /** Marks the chosen layer, and explains it. */
  layer(id) {
    const input = element("layers").querySelector(`input[value="${id}"]`);
    if (input) input.checked = true;
    this.says(LAYERS.find((each) => each.id === id)?.says ?? "");
    this.#legend = id;
    this.recolour();
  }

  /** Says what the chosen layer shows. */
  says(text) {
    if (element("layer-says").textContent !== text) element("layer-says").textContent = text;
  }

  /** Draws the legend anew, in the colours of the theme. */
  recolour() {
    const by = measure(this.#legend);
    element("legend").replaceChildren(by ? ramp(by) : this.#legend === "change" ? changes() : paints());
  }

  /** Lists what happened to the road; nothing where that is not the layer. */
  happened(events, choose) {
    element("happened").hidden = !events?.length;
    element("happened").replaceChildren(...list(events ?? [], choose));
  }

  /** Shows drives, the newest first; `total` counts those of the store. */
  drives(list, total) {
    const shown = list.slice(0, MOST_DRIVES);
    const alive = new Set(shown.map(({ id }) => id));
    for (const [id, row] of this.#rows) {
      if (!alive.has(id)) this.#rows.delete(id), row.remove();
    }
    shown.forEach((drive, index) => this.#row(drive, index));
    element("more-drives").hidden = total <= shown.length;
    element("more-drives").textContent = `and ${short(total - shown.length)} older ones, at /sessions`;
    element("drives-box").hidden = total === 0;
  }

  /** Marks a drive, or none, as the chosen one. */
  choose(id) {
    this.#chosen = id;
    for (const [each, row] of this.#rows) row.firstChild.setAttribute("aria-current", String(each === id));
  }

  #row(drive, index) {
    let row = this.#rows.get(drive.id);
    if (!row) {
      row = document.createElement("li");
      row.innerHTML = `<button type="button" class="choose"><span class="dot"></span><span class="name"></span><span class="state"></span><span class="figures"></span></button>`;
      row.style.setProperty("--drive", colourOf(drive.id));
      row.dataset.drive = drive.id;
      row.firstChild.title = `Drive ${drive.id}: what it alone saw, to replay`;
      row.firstChild.setAttribute("aria-current", String(drive.id === this.#chosen));
      row.firstChild.addEventListener("click", () => this.#on.drive(drive.id === this.#chosen ? undefined : drive.id));
      this.#rows.set(drive.id, row);
    }
    const at = element("drives").children[index];
    if (at !== row) element("drives").insertBefore(row, at ?? null);
    const say = (name, text) => {
      const cell = row.querySelector(`.${name}`);
      if (cell.textContent !== text) cell.textContent = text;
    };
    say("name", `Drive ${drive.number}`);
    say("state", drive.state);
    row.querySelector(".state").dataset.state = drive.state;
    const place = { "own frame": " · own frame, no GNSS", "kept apart": " · kept apart" }[drive.placement] ?? "";
    say("figures", `${short(drive.lanes)} lanes · ${short(drive.frames)} frames${place}`);
  }
}

function paints() {
  const theme = colours();
  const list = document.createElement("ul");
  list.append(...LEGEND.map(({ name, category }) => {
    const item = document.createElement("li");
    item.innerHTML = swatch(category, theme);
    item.append(name);
    return item;
  }));
  return list;
}

function changes() {
  const list = document.createElement("ul");
  const kinds = [["appeared", "appeared"], ["moved", "moved"], ["repainted", "repainted"], ["vanished", "vanished, dashed"]];
  list.append(...kinds.map(([kind, name]) => {
    const item = document.createElement("li");
    item.innerHTML = `<span class="dash-swatch"></span>`;
    item.firstChild.style.borderColor = `var(--${kind})`;
    if (kind === "vanished") item.firstChild.dataset.dashed = "";
    item.append(name);
    return item;
  }));
  return list;
}

function ramp(by) {
  const box = document.createElement("div");
  box.innerHTML = `<div class="ramp" role="img"></div><div class="ramp-labels"></div>`;
  box.firstChild.style.background = `linear-gradient(to right, ${by.colours.join(", ")})`;
  box.firstChild.setAttribute("aria-label", `Scale from ${by.labels[0]} to ${by.labels.at(-1)}`);
  box.lastChild.append(...by.labels.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  return box;
}

/** A count as it fits into little room. */
export function short(count) {
  return count < 10000 ? String(Math.round(count)) : Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 }).format(count);
}
