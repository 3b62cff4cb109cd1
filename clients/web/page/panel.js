// The panel: the state of the connection, the sessions, the legend.

import { LEGEND, swatch } from "./paint.js";

/** Colours by which sessions are told apart: vehicles on the map and dots in the list. */
export const SESSION_COLOURS = [
  "#2f9bff", "#ff7a45", "#3ecf8e", "#e255c5", "#a78bfa", "#18c5d9", "#f25f5c", "#8fbf26", "#f2b632", "#b98a5e",
];

/** The colour's index of a session that has its number. */
export function colourIndex(session) {
  return session.number % SESSION_COLOURS.length;
}

const element = (id) => document.getElementById(id);

export class Panel {
  #rows = new Map();
  #chosen;

  /** `on.choose(id)`, `on.overview()` and `on.follow()` are called as their buttons and keys are pressed. */
  constructor(on) {
    this.on = on;
    element("overview").addEventListener("click", on.overview);
    element("follow").addEventListener("click", on.follow);
    element("fold").addEventListener("click", () => this.fold());
    document.addEventListener("keydown", (event) => this.#key(event));
    if (matchMedia("(max-width: 699px)").matches) element("legend-box").open = false;
  }

  connection(state) {
    const pill = element("connection");
    pill.dataset.state = state;
    pill.textContent = state === "lost" ? "no connection" : state;
  }

  /** Shows the newest of `count` sessions as the server listed them, the newest first. */
  sessions(list, count) {
    const sum = (field) => list.reduce((total, session) => total + session[field], 0);
    const live = list.filter((session) => session.state === "live").length;
    const totals = { live, sessions: count, lanes: sum("lanes"), frames: sum("frames") };
    for (const [name, value] of Object.entries(totals)) {
      document.querySelector(`[data-total="${name}"]`).textContent = short(value);
    }
    element("no-sessions").hidden = list.length > 0;
    const alive = new Set(list.map((session) => session.id));
    for (const [id, row] of this.#rows) {
      if (!alive.has(id)) this.#rows.delete(id), row.remove();
    }
    for (const session of list.toReversed()) this.#row(session);
  }

  /** Marks a session, or none, as the chosen one. */
  choose(id, { local, following }) {
    this.#chosen = id;
    for (const [each, row] of this.#rows) row.firstChild.setAttribute("aria-current", String(each === id));
    element("local-banner").hidden = !local;
    element("follow").disabled = id === undefined;
    element("follow").setAttribute("aria-pressed", String(following));
  }

  legend(colours) {
    const items = LEGEND.map(({ name, category }) => {
      const item = document.createElement("li");
      item.innerHTML = swatch(category, colours);
      item.append(name);
      return item;
    });
    element("legend").replaceChildren(...items);
  }

  fold() {
    const folded = element("panel").classList.toggle("folded");
    element("fold").setAttribute("aria-expanded", String(!folded));
  }

  #row(session) {
    let row = this.#rows.get(session.id);
    if (!row) {
      row = document.createElement("li");
      row.innerHTML = `<button type="button"><span class="dot"></span><span class="name"><span></span> <code></code></span><span class="state"></span><span class="figures"></span></button>`;
      row.style.setProperty("--session", SESSION_COLOURS[colourIndex(session)]);
      row.querySelector("code").textContent = session.id;
      row.firstChild.title = `Fly to ${session.id}`;
      row.firstChild.setAttribute("aria-current", String(session.id === this.#chosen));
      row.firstChild.addEventListener("click", () => this.on.choose(session.id));
      this.#rows.set(session.id, row);
      element("sessions").prepend(row);
    }
    row.querySelector(".name span").textContent = `Drive ${session.number}`;
    const state = row.querySelector(".state");
    state.textContent = state.dataset.state = session.state;
    const where = session.georeferenced ? "" : " · own frame";
    row.querySelector(".figures").textContent = `${short(session.lanes)} lanes · ${short(session.frames)} frames${where}`;
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Escape") this.on.overview();
    else if (event.key === "f" || event.key === "F") this.on.follow();
    else if (event.key === "p" || event.key === "P") this.fold();
  }
}

function short(count) {
  return count < 10000 ? String(count) : Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 }).format(count);
}
