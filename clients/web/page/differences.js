// The layer "change": where the map is another one than it was at the time that the slider shows.

/** Least time between two looks, milliseconds. */
const PAUSE_MS = 1500;

export class Differences {
  #server;
  #draw;
  #asked;
  #looking = false;
  #timer;

  /** `draw(features, more)` is called with what differs, `more` where there is more than that. */
  constructor(server, draw) {
    this.#server = server;
    this.#draw = draw;
  }

  /** Looks at what differs within a box since a revision; soon, where it has just looked. */
  look(since, box) {
    this.#asked = { since, box };
    if (!this.#looking && this.#timer === undefined) this.#run();
  }

  /** Looks no more. */
  stop() {
    this.#asked = undefined;
    clearTimeout(this.#timer);
    this.#timer = undefined;
    this.#draw([]);
  }

  async #run() {
    const { since, box } = this.#asked;
    this.#asked = undefined;
    this.#looking = true;
    try {
      const corners = box.map((degrees, side) => Math.min(Math.max(degrees, side % 2 ? -90 : -180), side % 2 ? 90 : 180));
      const told = await this.#server.json(`differences?since=${since}&bbox=${corners.map((degrees) => degrees.toFixed(6))}`);
      if (this.#timer === undefined) this.#draw(told.features.map(flat), told.more);
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

/** Cell and line of the feature, as the map's own lines have them. */
function flat(feature) {
  return { ...feature, properties: { ...feature.properties, part: 0 } };
}
