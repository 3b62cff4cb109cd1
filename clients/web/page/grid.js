// The grid behind the map: squares of a round number of metres, so that an empty map still has a scale.

import { degreesOf, metresPerPixel } from "./geometry.js";

/** Least size of a square, pixels. */
const SQUARE_PX = 70;
/** Most lines in one direction. */
const MOST_LINES = 80;

export class Grid {
  #metres;
  #drawn;

  /** The grid for what `map` shows now, as GeoJSON lines, `major` every fifth; `undefined` where the last one still does. */
  cover(map) {
    const latitude = Math.round(Math.min(Math.max(map.getCenter().lat, -80), 80));
    const metres = roundUp(SQUARE_PX * metresPerPixel(map.getZoom(), latitude));
    const bounds = map.getBounds();
    const view = [bounds.getWest(), bounds.getSouth(), bounds.getEast(), bounds.getNorth()];
    if (metres === this.#metres && isWithin(view, this.#drawn)) return undefined;
    [this.#metres, this.#drawn] = [metres, widened(view)];
    return gridOf(this.#drawn, degreesOf(metres, latitude));
  }
}

function gridOf([west, south, east, north], step) {
  const meridians = multiples(step.east, west, east).map(([value, major]) => line(major, [[value, south], [value, north]]));
  const parallels = multiples(step.north, south, north).map(([value, major]) => line(major, [[west, value], [east, value]]));
  return { type: "FeatureCollection", features: [...meridians, ...parallels] };
}

function isWithin(inner, outer) {
  return inner[0] >= outer[0] && inner[1] >= outer[1] && inner[2] <= outer[2] && inner[3] <= outer[3];
}

/** A box with half its size more on each side, for the map to be moved in. */
function widened([west, south, east, north]) {
  const [across, up] = [(east - west) / 2, (north - south) / 2];
  return [west - across, Math.max(south - up, -85), east + across, Math.min(north + up, 85)];
}

/** The layers that draw the source "grid". */
export function gridLayers(colours) {
  return [{
    id: "grid",
    type: "line",
    source: "grid",
    paint: { "line-color": ["case", ["get", "major"], colours["grid-major"], colours.grid], "line-width": 1 },
  }];
}

/** The next of 1, 2, 5, 10, 20, .. not below `metres`. */
function roundUp(metres) {
  const decade = 10 ** Math.floor(Math.log10(metres));
  return decade * [1, 2, 5, 10].find((factor) => factor * decade >= metres);
}

function multiples(step, from, to) {
  const first = Math.ceil(from / step);
  const count = Math.min(Math.floor(to / step) - first + 1, MOST_LINES);
  return Array.from({ length: Math.max(count, 0) }, (_, index) => [(first + index) * step, (first + index) % 5 === 0]);
}

function line(major, coordinates) {
  return { type: "Feature", properties: { major }, geometry: { type: "LineString", coordinates } };
}
