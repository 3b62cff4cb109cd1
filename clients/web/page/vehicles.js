// Vehicles in motion: each glides from where it was to where it is told to be, in the time that updates take.

import { moving } from "./theme.js";

/** Colours by which drives are told apart: vehicles on the map and dots in the list. */
const COLOURS = [
  "#2f8fef", "#f0703c", "#2fb57e", "#d44fb7", "#8f78e8", "#12aebf", "#e5524f", "#7da61f", "#dca127", "#a97f54",
];

/** Longest time that a vehicle takes to its new place: it is never farther behind. */
const LONGEST_MS = 2000;
/** How often the vehicles are drawn while they move. */
const FRAME_MS = 33;
/** Farther than this a vehicle does not glide, but is there: degrees. */
const JUMP_DEG = 0.003;

/** The number of a drive's colour: the same for the same drive on every page. */
export function colourNumber(id) {
  return [...id.slice(-6)].reduce((hash, letter) => (hash * 31 + letter.charCodeAt(0)) % 9973, 7) % COLOURS.length;
}

export function colourOf(id) {
  return COLOURS[colourNumber(id)];
}

export class Vehicles {
  #vehicles = new Map();
  #draw;
  #running = false;
  #drawnAt = 0;
  #told = performance.now();

  /** `draw(features)` is called with the vehicles as they move. */
  constructor(draw) {
    this.#draw = draw;
  }

  /**
   * Takes where vehicles are: `[{ id, place: [lon, lat], heading, chosen }]`. Those that are missing are gone. Where it is not
   * told, the others take as long to get there as it is since they were last told.
   */
  tell(list, { takesMs: wantedMs } = {}) {
    const now = performance.now();
    const takesMs = moving(wantedMs ?? Math.min(now - this.#told + 100, LONGEST_MS));
    this.#told = now;
    const alive = new Set(list.map(({ id }) => id));
    for (const id of [...this.#vehicles.keys()].filter((id) => !alive.has(id))) this.#vehicles.delete(id);
    for (const { id, place, heading, chosen } of list) {
      const before = this.#vehicles.get(id);
      const from = before && near(before, place, now) ? at(before, now) : { place, heading };
      const still = before && before.to.place[0] === place[0] && before.to.place[1] === place[1];
      if (still && before.until > now) before.chosen = chosen;
      else this.#vehicles.set(id, { from, to: { place, heading }, since: now, until: now + takesMs, chosen });
    }
    this.#run();
  }

  /** Where a vehicle is drawn now. */
  place(id) {
    const vehicle = this.#vehicles.get(id);
    return vehicle && at(vehicle, performance.now()).place;
  }

  #run() {
    if (this.#running) return;
    this.#running = true;
    const step = (now) => {
      if (now - this.#drawnAt >= FRAME_MS) {
        this.#drawnAt = now;
        this.#draw(this.#features(now));
      }
      this.#running = [...this.#vehicles.values()].some(({ until }) => until > now);
      if (this.#running) requestAnimationFrame(step);
      else this.#draw(this.#features(now));
    };
    requestAnimationFrame(step);
  }

  #features(now) {
    return [...this.#vehicles].map(([id, vehicle]) => {
      const { place, heading } = at(vehicle, now);
      return {
        type: "Feature",
        geometry: { type: "Point", coordinates: place },
        properties: { drive: id, heading, chosen: vehicle.chosen, icon: `vehicle-${colourNumber(id)}` },
      };
    });
  }
}

function near({ to }, place, now) {
  return Math.abs(to.place[0] - place[0]) < JUMP_DEG && Math.abs(to.place[1] - place[1]) < JUMP_DEG && now >= 0;
}

function at({ from, to, since, until }, now) {
  if (now >= until) return to;
  const part = Math.max(now - since, 0) / (until - since);
  const turn = ((to.heading - from.heading + 540) % 360) - 180;
  return {
    place: [0, 1].map((axis) => from.place[axis] + part * (to.place[axis] - from.place[axis])),
    heading: from.heading + part * turn,
  };
}

/** The icons of vehicles, by name: seen from above, an arrowhead that points up, with a white rim and a soft shadow. */
export function vehicleIcons() {
  return COLOURS.map((colour, number) => [`vehicle-${number}`, arrow(colour)]);
}

function arrow(colour) {
  const size = 64;
  const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
  const pen = canvas.getContext("2d");
  pen.translate(size / 2, size / 2);
  pen.beginPath();
  for (const [x, y] of [[0, -24], [17, 20], [0, 11], [-17, 20]]) pen.lineTo(x, y);
  pen.closePath();
  pen.lineJoin = "round";
  pen.shadowColor = "rgba(0, 0, 0, .5)";
  pen.shadowBlur = 7;
  pen.lineWidth = 7;
  pen.strokeStyle = "#ffffff";
  pen.stroke();
  pen.shadowBlur = 0;
  pen.fillStyle = colour;
  pen.fill();
  return pen.getImageData(0, 0, size, size);
}
