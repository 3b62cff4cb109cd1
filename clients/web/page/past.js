// The map's past: which revisions there are to go back to, as a timeline for the bar.

import { clock } from "./bar.js";

/** The whole past plays in about so many milliseconds. */
const PLAYS_IN_MS = 20_000;

export class Past {
  /** The oldest revision that is kept; nothing where the map never changed. */
  oldest;
  #steps = [];
  #server;
  #on;

  /** `on.revision(revision)` is called with the revision to show, `undefined` for the newest. */
  constructor(server, on) {
    this.#server = server;
    this.#on = on;
  }

  /** Asks which revisions there are; says whether that changed. */
  async look() {
    const told = await this.#server.changed("timeline");
    if (told) {
      this.#steps = told.steps.map(({ revision, at }) => ({ revision, ms: Date.parse(at) }));
      this.oldest = told.steps.length > 0 ? told.oldest : undefined;
    }
    return told !== undefined;
  }

  /** When the oldest was there, milliseconds. */
  get from() {
    return this.#steps[0]?.ms;
  }

  /** The timeline of the bar; nothing where there is no past. */
  timeline() {
    if (this.#steps.length < 2) return undefined;
    const [from, to] = [this.#steps[0].ms, this.#steps.at(-1).ms];
    return {
      label: "Versions of the map",
      from,
      to,
      ticks: this.#steps.map(({ ms }) => ms),
      speed: Math.max((to - from) / PLAYS_IN_MS, 1),
      say: (ms, live) => (live ? "now" : clock(ms)),
      at: (ms) => this.#on.revision(this.revisionAt(ms)),
      live: () => this.#on.revision(undefined),
    };
  }

  /** The last revision that was there at a time. */
  revisionAt(ms) {
    return (this.#steps.findLast((step) => step.ms <= ms) ?? this.#steps[0])?.revision;
  }

  /** When a revision was there, milliseconds; nothing of one that is not kept. */
  timeOf(revision) {
    if (this.#steps.length === 0 || revision < this.#steps[0].revision) return undefined;
    return this.#steps.findLast((step) => step.revision <= revision)?.ms;
  }
}
