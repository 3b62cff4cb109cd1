// The bar below: one slider for time, through the versions of the map or along a drive.

const element = (id) => document.getElementById(id);
const PLAY = `<svg viewBox="0 0 20 20" aria-hidden="true"><path d="M6 4l10 6-10 6z"/></svg>`;
const PAUSE = `<svg viewBox="0 0 20 20" aria-hidden="true"><path d="M5.5 4h3v12h-3zM11.5 4h3v12h-3z"/></svg>`;
/** Steps of the slider. */
const STEPS = 1000;
/** Part of the way that an arrow key takes. */
const KEY_STEPS = 10;

export class Bar {
  #timeline;
  #playing = false;
  #last;
  #at = 1;

  /**
   * Shows a timeline, or none: `{ from, to }` in milliseconds, `ticks` (times at which something happened), `at(ms)` called
   * as time is chosen, `live()` as the newest is asked for, `say(ms)` what to write of a time, `speed` (how many times as
   * fast as the clock it plays), `label`.
   */
  constructor() {
    element("time").max = STEPS;
    element("time").step = 1;
    element("time").addEventListener("input", ({ target }) => {
      this.pause();
      this.#choose(target.value / STEPS);
    });
    element("time").addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[event.key];
      if (!by) return;
      event.preventDefault();
      this.pause();
      this.#choose(Math.min(Math.max(this.#at + (by * KEY_STEPS) / STEPS, 0), 1));
    });
    element("play").addEventListener("click", () => this.toggle());
    element("now").addEventListener("click", () => this.live());
    new ResizeObserver(() => this.#ticks()).observe(element("track"));
  }

  /** Shows another timeline; keeps its time where it is the same one grown, else goes to its end. */
  show(timeline) {
    const same = timeline && this.#timeline?.label === timeline.label;
    const at = same && !this.isLive ? this.ms : undefined;
    if (!same) this.pause();
    this.#timeline = timeline;
    element("bar").hidden = !timeline;
    if (!timeline) return;
    element("time").setAttribute("aria-label", timeline.label);
    element("now").hidden = !timeline.live;
    element("now").textContent = timeline.end ?? "Live";
    if (at !== undefined) this.#at = Math.min(Math.max((at - timeline.from) / (timeline.to - timeline.from || 1), 0), 0.9999);
    else this.#at = 1;
    this.#write();
    this.#ticks();
  }

  /** Whether the bar stands at the end of its timeline. */
  get isLive() {
    return this.#at >= 1;
  }

  get isPlaying() {
    return this.#playing;
  }

  /** The time at which it stands, milliseconds. */
  get ms() {
    return this.#timeline.from + this.#at * (this.#timeline.to - this.#timeline.from);
  }

  /** Stands at a time. */
  goTo(ms) {
    this.#choose(Math.min(Math.max((ms - this.#timeline.from) / (this.#timeline.to - this.#timeline.from || 1), 0), 1));
  }

  live() {
    this.pause();
    this.#at = 1;
    this.#write();
    this.#timeline?.live?.();
  }

  toggle() {
    if (!this.#timeline) return;
    if (this.#playing) this.pause();
    else this.play();
  }

  play() {
    if (this.#playing || !this.#timeline) return;
    if (this.isLive) this.#choose(0);
    this.#playing = true;
    this.#last = undefined;
    this.#write();
    requestAnimationFrame((now) => this.#step(now));
  }

  pause() {
    if (!this.#playing) return;
    this.#playing = false;
    this.#write();
  }

  #step(now) {
    if (!this.#playing) return;
    const passed = now - (this.#last ?? now);
    this.#last = now;
    const { from, to, speed } = this.#timeline;
    const next = this.#at + (passed * speed) / Math.max(to - from, 1);
    if (next >= 1) this.live();
    else {
      this.#choose(next);
      requestAnimationFrame((later) => this.#step(later));
    }
  }

  #choose(part) {
    this.#at = part;
    this.#write();
    if (this.isLive) this.#timeline.live?.();
    this.#timeline.at(this.ms);
  }

  #write() {
    const says = this.#timeline?.say(this.ms, this.isLive) ?? "";
    element("time").value = Math.round(this.#at * STEPS);
    element("time").setAttribute("aria-valuetext", says);
    element("moment").textContent = says;
    element("now").setAttribute("aria-pressed", String(this.isLive));
    element("play").innerHTML = this.#playing ? PAUSE : PLAY;
    element("play").setAttribute("aria-label", this.#playing ? "Pause" : "Play");
  }

  /** Draws how much happened when. */
  #ticks() {
    const canvas = element("ticks");
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!this.#timeline?.ticks || width === 0) return canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    const scale = devicePixelRatio;
    Object.assign(canvas, { width: width * scale, height: height * scale });
    const pen = canvas.getContext("2d");
    pen.scale(scale, scale);
    pen.fillStyle = getComputedStyle(element("moment")).color;
    pen.globalAlpha = 0.42;
    const { from, to, ticks } = this.#timeline;
    const columns = new Array(Math.max(Math.floor(width / 3), 1)).fill(0);
    for (const ms of ticks) {
      const column = Math.floor(((ms - from) / (to - from || 1)) * columns.length);
      columns[Math.min(Math.max(column, 0), columns.length - 1)] += 1;
    }
    const most = Math.max(...columns, 1);
    columns.forEach((count, index) => {
      if (count === 0) return;
      const tall = 2 + (height - 4) * Math.sqrt(count / most);
      pen.fillRect(index * 3, height - tall, 2, tall);
    });
    return undefined;
  }
}

/** A time of the day, with the day where it is not today, and the year where it is not this one. */
export function clock(ms) {
  const date = new Date(ms);
  const now = new Date();
  const time = date.toLocaleTimeString("en-GB");
  if (now.toDateString() === date.toDateString()) return time;
  const year = now.getFullYear() === date.getFullYear() ? undefined : "numeric";
  return `${date.toLocaleDateString("en-GB", { day: "numeric", month: "short", year })} ${time}`;
}

/** A time since the start, minutes and seconds. */
export function elapsed(ms) {
  const seconds = Math.max(Math.round(ms / 1000), 0);
  return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
}
