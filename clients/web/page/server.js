// The server: every request of the page goes through here, with the token where one is asked for.

const TOKEN = "lanemap.token";
const PERIOD_MS = 1000;
const LONGEST_PAUSE_MS = 15000;

/** An answer that is a refusal: its status, and what its problem document says. */
export class Refused extends Error {
  constructor(status, problem) {
    super(problem?.detail ?? problem?.title ?? `the server answers ${status}`);
    this.status = status;
  }
}

export class Server {
  /** "connecting", "connected", "lost" or "locked": the server wants a token. */
  state = "connecting";
  #on;
  #tags = new Map();
  #wake = () => {};

  /** `on.state(state, reason)` is called when the connection's state changes. */
  constructor(on) {
    this.#on = on;
  }

  /** The address of a path beside the page, so that a prefix before the service is kept. */
  address(path) {
    return new URL(path, document.baseURI).href;
  }

  /** What goes with every request: the token, where there is one. */
  headers() {
    const token = sessionStorage.getItem(TOKEN);
    return token ? { Authorization: `Bearer ${token}` } : {};
  }

  /** Keeps a token for as long as the tab is open, and tries again with it. */
  unlock(token) {
    sessionStorage.setItem(TOKEN, token.trim());
    // One that is refused is told as the first was.
    this.enter("connecting");
    this.hurry();
  }

  /** The JSON at `path`. Throws `Refused`, or a `TypeError` where the server does not answer. */
  async json(path, options = {}) {
    return (await this.#fetch(path, options)).json();
  }

  /** The JSON at `path`, or `undefined` where it did not change since the last call. */
  async changed(path) {
    const tag = this.#tags.get(path);
    const response = await this.#fetch(path, { headers: tag ? { "If-None-Match": tag } : {} });
    if (response.status === 304) {
      await response.arrayBuffer();
      return undefined;
    }
    const body = await response.json();
    this.#tags.set(path, response.headers.get("ETag"));
    return body;
  }

  /** Forgets what was fetched: the server may be another one. */
  forget() {
    this.#tags.clear();
  }

  /**
   * Calls `look` every second while the page is seen and the server answers, ever more rarely while it does not, and keeps
   * the state of the connection.
   */
  async watch(look) {
    for (let pause = PERIOD_MS; ; ) {
      await untilVisible();
      try {
        await look();
        this.enter("connected");
        pause = PERIOD_MS;
      } catch (error) {
        if (error instanceof Refused && error.status === 401) this.enter("locked", error.message);
        else {
          if (!(error instanceof TypeError || error instanceof Refused)) console.error(error);
          this.enter("lost", error.message);
        }
        pause = Math.min(pause * 2, LONGEST_PAUSE_MS);
      }
      await new Promise((resume) => {
        this.#wake = resume;
        setTimeout(resume, pause);
      });
    }
  }

  /** Looks now. */
  hurry() {
    this.#wake();
  }

  enter(state, reason) {
    if (state === this.state) return;
    this.state = state;
    this.#on.state(state, reason);
  }

  /**
   * Follows the server-sent events at `path`: calls `hear(name, data, id)` for each, until the stream ends or `signal` stops
   * it. Not an `EventSource`, which sends no token.
   */
  async follow(path, hear, { signal, lastId } = {}) {
    const headers = { Accept: "text/event-stream", ...(lastId ? { "Last-Event-ID": lastId } : {}) };
    const response = await this.#fetch(path, { headers, signal });
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    let rest = "";
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      const blocks = (rest + value).split(/\r?\n\r?\n/);
      rest = blocks.pop();
      for (const block of blocks) {
        const event = parse(block);
        if (event.data !== undefined) hear(event.event ?? "message", event.data, event.id);
      }
    }
  }

  async #fetch(path, { headers = {}, signal } = {}) {
    const response = await fetch(this.address(path), {
      cache: "no-store", signal, headers: { ...this.headers(), ...headers },
    });
    if (response.ok || response.status === 304) return response;
    const problem = await response.json().catch(() => undefined);
    throw new Refused(response.status, problem);
  }
}

/** The fields of one server-sent event. */
function parse(block) {
  const event = {};
  for (const line of block.split(/\r?\n/)) {
    const [, name, value] = /^([^:]+):? ?(.*)$/.exec(line) ?? [];
    if (!name) continue;
    event[name] = name === "data" && event.data !== undefined ? `${event.data}\n${value}` : value;
  }
  return event;
}

function untilVisible() {
  if (!document.hidden) return undefined;
  return new Promise((resume) => document.addEventListener("visibilitychange", resume, { once: true }));
}
