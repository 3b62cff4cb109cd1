// The feed: what there is on the server now. Looks once a second, and fetches nothing that did not change.
//
// Cells are looked at when the server says on `/changes` that one did; where that stream is not to be had, once a second.

/** Drives that are listed. */
const DRIVES = 60;
/** Rounds from one look at what changes slowly to the next. */
const SLOWLY = 3;
/** Time that changes get to become more before they are looked at, milliseconds. */
const GATHER_MS = 250;
/** Pause before the stream of changes is opened again, milliseconds. */
const AGAIN_MS = 3000;

export class Feed {
  /** The cells of the shared map. */
  cells = [];
  /** The newest drives, each with its number in the order in which they began. */
  drives = [];
  /** How many drives there are. */
  total = 0;
  /** The vehicles that stream now, GeoJSON features. */
  vehicles = [];
  #server;
  #past;
  #on;
  #round = 0;
  #versions;
  /** Whether the server tells what changes, and whether it told of something that was not looked at yet. */
  #following = false;
  #stale = true;
  #lastId;
  #soon;

  /**
   * `on.cells(changed)` is called with the cells whose version is another one, `on.drives()`, `on.vehicles(totals)` and
   * `on.past()` when theirs changed, `on.round()` after each look.
   */
  constructor(server, past, on) {
    this.#server = server;
    this.#past = past;
    this.#on = on;
  }

  /** Everything is to be fetched anew: the server was away. */
  forget() {
    this.#server.forget();
    this.#round = 0;
    this.#versions = undefined;
    this.#stale = true;
  }

  async look() {
    const vehicles = await this.#server.changed("sessions/live?limit=2000");
    if (vehicles) {
      this.vehicles = vehicles.features;
      this.#on.vehicles({ live: vehicles.live, drives: vehicles.drives });
    }
    // Drives first: where they were tells what to look at.
    if (this.#round % SLOWLY === 0) await this.#lookAtDrives();
    if (this.#stale || !this.#following) await this.#lookAtCells();
    if (this.#round % SLOWLY === 0 && await this.#past.look()) this.#on.past();
    this.#round += 1;
    this.#on.round();
  }

  /** Listens to what changes, for ever. */
  async follow() {
    for (;;) {
      try {
        await this.#server.follow("changes", (name, _, id) => this.#hear(name, id), { lastId: this.#lastId });
      } catch (error) {
        // Too many listen, or the server is away: it is asked once a second, and this again later.
        if (error.status === 400) this.#lastId = undefined;
      }
      this.#following = false;
      await new Promise((resume) => setTimeout(resume, AGAIN_MS));
    }
  }

  #hear(name, id) {
    this.#following = true;
    this.#lastId = id ?? this.#lastId;
    // Also at the start: what changed since the cells were listed is not told.
    if (!["start", "cell", "reset"].includes(name)) return;
    this.#stale = true;
    this.#soon ??= setTimeout(() => {
      this.#soon = undefined;
      this.#server.hurry();
    }, GATHER_MS);
  }

  async #lookAtCells() {
    this.#stale = false;
    const list = await this.#server.changed("cells?limit=10000");
    if (!list) return;
    const versions = this.#versions;
    this.#versions = new Map(list.cells.map(({ id, version }) => [id, version]));
    this.cells = list.cells;
    // Tiles that are asked for from now on have what is told first.
    this.#on.cells(versions ? list.cells.filter(({ id, version }) => versions.get(id) !== version) : []);
  }

  async #lookAtDrives() {
    const list = await this.#server.changed(`sessions?limit=${DRIVES}`);
    if (!list) return;
    this.total = list.total;
    // The newest come first.
    this.drives = list.sessions.map((session, index) => ({ ...session, number: list.total - index }));
    this.#on.drives();
  }
}
