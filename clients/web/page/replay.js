// One drive, replayed: where its vehicle was, and what it alone had seen by then.
//
// The server keeps a drive's lanes as they came to be, not every state of them: a part of a lane is shown from the moment
// the vehicle came near enough to see it, within the time in which the lane was seen.

import { boxOf, distance, placeLocal, placeLocalGeometry } from "./geometry.js";

/** How far a vehicle is taken to see, metres. */
const SIGHT_M = 45;
/** How often the lanes are drawn while a drive plays. */
const FRAME_MS = 90;

export class Replay {
  /** The drive's id, version and whether it has a place on the earth. */
  drive;
  #trace;
  #lanes = [];
  #draw;
  #drawn = 0;
  #later;

  /** `draw({ lanes, trace, vehicle })` is called with what is to be seen. */
  constructor(drive, draw) {
    this.drive = drive;
    this.#draw = draw;
  }

  /** Fetches the drive as it is now; says whether it has anything to show. */
  async fetch(server) {
    const query = this.drive.georeferenced ? "" : "?crs=local";
    const path = `sessions/${encodeURIComponent(this.drive.id)}`;
    const [trace, lanes] = await Promise.all([
      server.json(`${path}/trace.geojson${query}`), server.json(`${path}/lanes.geojson${query}`),
    ]);
    const local = !this.drive.georeferenced;
    const places = trace.geometry.coordinates.map((place) => (local ? placeLocal(place) : place.slice(0, 2)));
    this.#trace = { places, times: trace.properties.times_ms, headings: trace.properties.headings_deg };
    this.#lanes = lanes.features.map((feature) => this.#lane(local ? placed(feature) : feature));
    return places.length > 0;
  }

  get from() {
    return this.#trace.times[0];
  }

  get to() {
    return this.#trace.times.at(-1);
  }

  /** The box around all that there is of the drive. */
  get box() {
    const line = { coordinates: this.#trace.places };
    return boxOf([line, ...this.#lanes.map(({ feature }) => feature.geometry)]);
  }

  /** Shows the drive at a time; all of it where there is none. Lanes follow a moment later while time runs. */
  show(ms, { whole = false } = {}) {
    const at = ms ?? this.to;
    const now = performance.now();
    clearTimeout(this.#later);
    if (whole || now - this.#drawn >= FRAME_MS) {
      this.#drawn = now;
      this.#draw(this.#seen(at));
    } else {
      this.#draw({ vehicle: this.#vehicle(at) });
      this.#later = setTimeout(() => this.#draw(this.#seen(at)), FRAME_MS);
    }
  }

  /** Draws no more. */
  stop() {
    clearTimeout(this.#later);
  }

  #seen(ms) {
    const vehicle = this.#vehicle(ms);
    const { times, places } = this.#trace;
    const passed = places.slice(0, upTo(times, ms));
    const trace = passed.length > 0 ? [line([...passed, vehicle.place])] : [];
    return { vehicle, trace, lanes: this.#lanes.flatMap((lane) => seenBy(lane, ms)) };
  }

  #vehicle(ms) {
    const { times, places, headings } = this.#trace;
    const next = Math.min(Math.max(upTo(times, ms), 1), times.length - 1);
    const last = Math.max(next - 1, 0);
    const span = times[next] - times[last];
    const part = span > 0 ? Math.min(Math.max((ms - times[last]) / span, 0), 1) : 1;
    const turn = ((headings[next] - headings[last] + 540) % 360) - 180;
    return {
      place: [0, 1].map((axis) => places[last][axis] + part * (places[next][axis] - places[last][axis])),
      heading: headings[last] + part * turn,
    };
  }

  /** A lane with the time from which each of its points is seen. */
  #lane(feature) {
    const { first_seen, last_seen } = feature.properties;
    const [first, last] = [Date.parse(first_seen), Date.parse(last_seen)];
    const { type, coordinates } = feature.geometry;
    const lines = type === "MultiLineString" ? coordinates : [coordinates];
    return { feature, lines: lines.map((points) => ({ points, times: points.map((point) => this.#seenAt(point, first, last)) })) };
  }

  #seenAt(point, first, last) {
    const { times, places } = this.#trace;
    for (let index = upTo(times, first - 1); index < times.length && times[index] <= last; index += 1) {
      if (distance(places[index], point) < SIGHT_M) return Math.max(times[index], first);
    }
    return last;
  }
}

/** Number of times that are not after `ms`. */
function upTo(times, ms) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= ms) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The runs of a lane's points that are seen by a time. */
function seenBy({ feature, lines }, ms) {
  const runs = lines.flatMap(({ points, times }) => {
    const found = [];
    let run = [];
    points.forEach((point, index) => {
      if (times[index] <= ms) run.push(point);
      else if (run.length > 0) found.push(run), (run = []);
    });
    return [...found, run].filter(({ length }) => length > 1);
  });
  if (runs.length === 0) return [];
  return [{ ...feature, geometry: { type: "MultiLineString", coordinates: runs } }];
}

function placed(feature) {
  return { ...feature, geometry: placeLocalGeometry(feature.geometry) };
}

function line(coordinates) {
  return { type: "Feature", properties: {}, geometry: { type: "LineString", coordinates } };
}
