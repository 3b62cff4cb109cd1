// What is asked for within the view: again when that moves, and when what is asked for changed, but not too often.

/** Least time between two looks, milliseconds. */
const PAUSE_MS = 1500;

export class Around {
  #server;
  #path;
  #draw;
  #asked;
  #looking = false;
  #timer;

  /** `path(asked)` is what to ask for, to which the view's `bbox` is added; `draw(told)` is called with the answer. */
  constructor(server, path, draw) {
    this.#server = server;
    this.#path = path;
    this.#draw = draw;
  }

  /** Looks within a box; soon, where it has just looked. */
  look(box, asked) {
    this.#asked = { box, asked };
    if (!this.#looking && this.#timer === undefined) this.#run();
  }

  /** Looks no more. */
  stop() {
    this.#asked = undefined;
    clearTimeout(this.#timer);
    this.#timer = undefined;
    this.#draw({ features: [] });
  }

  async #run() {
    const { box, asked } = this.#asked;
    this.#asked = undefined;
    this.#looking = true;
    try {
      const corners = box.map((degrees, side) => Math.min(Math.max(degrees, side % 2 ? -90 : -180), side % 2 ? 90 : 180));
      const told = await this.#server.json(`${this.#path(asked)}&bbox=${corners.map((degrees) => degrees.toFixed(6))}`);
      if (this.#timer === undefined) this.#draw(told);
    } catch (error) {
      // That the server is away is told by the feed.
      if (error.status === undefined && !(error instanceof TypeError)) throw error;
    }
    this.#looking = false;
    this.#timer = setTimeout(() => {
      this.#timer = undefined;
      if (this.#asked) this.#run();
    }, PAUSE_MS);
  }
}
