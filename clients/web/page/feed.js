// The feed: which sessions there are, the cells of the shared map, and the lanes of those that changed. Polls, and fetches
// nothing twice.

const PERIOD_MS = 1000;
const LONGEST_PAUSE_MS = 15000;

export class Feed {
  /** The sessions as the server last listed them, each with its number in the order in which they began. */
  sessions = [];
  /** The cells of the shared map as the server last listed them. */
  cells = [];
  /** What of each session and each cell was fetched last: its version and frame of reference. */
  #fetched = new Map();
  /** The entity tag of each address, for conditional requests. */
  #tags = new Map();
  #on;
  #wake = () => {};

  /**
   * `on.sessions(list, total)` is called when the list changed, `on.lanes(session, collection)` when a session's lanes did,
   * `on.cell(cell, collection)` when a cell's did, `on.gone(id)` when a session left the list, `on.connection(state)` with
   * "connected" or "lost"; `on.wants(session)` and `on.wantsCell(cell)` say whether its lanes are drawn at all.
   */
  constructor(on) {
    this.#on = on;
  }

  /** Polls for ever, slower while the server does not answer, and not at all while the page is hidden. */
  async run() {
    for (let pause = PERIOD_MS; ; ) {
      await untilVisible();
      try {
        await this.#poll();
        this.#on.connection("connected");
        pause = PERIOD_MS;
      } catch (error) {
        console.warn("the server does not answer:", error.message);
        this.#on.connection("lost");
        pause = Math.min(pause * 2, LONGEST_PAUSE_MS);
      }
      await new Promise((resume) => {
        this.#wake = resume;
        setTimeout(resume, pause);
      });
    }
  }

  /** Polls now: another session is wanted. */
  hurry() {
    this.#wake();
  }

  async #poll() {
    const list = await this.#fetchChanged("sessions");
    if (list) {
      // The list has the newest first, and may be the end of a longer one.
      this.sessions = list.sessions.map((session, index) => ({ ...session, number: list.total - index }));
      this.#forgetGone();
      this.#on.sessions(this.sessions, list.total);
    }
    for (const session of this.sessions) {
      const state = `${session.version} ${session.georeferenced}`;
      if (this.#fetched.get(session.id) === state || !this.#on.wants(session)) continue;
      const lanes = await this.#fetchChanged(lanesOf(session.id, session.georeferenced));
      if (lanes) this.#on.lanes(session, lanes);
      this.#fetched.set(session.id, state);
    }
    this.cells = (await this.#fetchChanged("cells"))?.cells ?? this.cells;
    for (const cell of this.cells) {
      if (this.#fetched.get(cell.id) === cell.version || !this.#on.wantsCell(cell)) continue;
      const lanes = await this.#fetchChanged(`cells/${cell.id}/lanes.geojson`);
      if (lanes) this.#on.cell(cell, lanes);
      this.#fetched.set(cell.id, cell.version);
    }
  }

  #forgetGone() {
    const alive = new Set([...this.sessions, ...this.cells].map(({ id }) => id));
    for (const id of [...this.#fetched.keys()].filter((id) => !alive.has(id))) {
      this.#fetched.delete(id);
      for (const georeferenced of [true, false]) this.#tags.delete(lanesOf(id, georeferenced));
      this.#on.gone(id);
    }
  }

  /** The JSON at `path`, or `undefined` where it did not change since the last call or the server refuses it. */
  async #fetchChanged(path) {
    const tag = this.#tags.get(path);
    const response = await fetch(path, { cache: "no-store", headers: tag ? { "If-None-Match": tag } : {} });
    if (response.status === 304) return undefined;
    if (!response.ok) {
      this.#tags.delete(path);
      if (path === "sessions" || path === "cells") throw new Error(`${path} answers ${response.status}`);
      return undefined;
    }
    const body = await response.json();
    this.#tags.set(path, response.headers.get("ETag"));
    return body;
  }
}

function lanesOf(id, georeferenced) {
  return `sessions/${encodeURIComponent(id)}/lanes.geojson${georeferenced ? "" : "?crs=local"}`;
}

function untilVisible() {
  if (!document.hidden) return undefined;
  return new Promise((resume) => document.addEventListener("visibilitychange", resume, { once: true }));
}
