// What lines are coloured by, beside their paint: how sure the map is of each stretch of them.
//
// Each measure has a scale of five colours that differ in lightness as well as in hue, made to be seen on asphalt.

import { groundWidth } from "./paint.js";

const GOOD_TO_BAD = ["#7fe0cf", "#b9dd7c", "#f6d65b", "#f39255", "#e5568a"];
const FEW_TO_MANY = ["#8794e6", "#5fb4ec", "#56cfbe", "#a9df6c", "#fbe85f"];
const NEW_TO_OLD = ["#fbe85f", "#a9df6c", "#56cfbe", "#6ba3e2", "#8d8fb8"];

const HOUR_S = 3600;
const DAY_S = 24 * HOUR_S;

/** The measures, in the order of their keys. `stops` are the values at which the colours stand. */
export const MEASURES = [
  {
    id: "sigma",
    name: "Uncertainty",
    says: "Standard deviation across the line",
    stops: [0.02, 0.05, 0.1, 0.2, 0.5],
    labels: ["2 cm", "5", "10", "20", "50 cm"],
    colours: GOOD_TO_BAD,
    value: () => ["get", "lateral_sigma_m"],
  },
  {
    id: "drives",
    name: "Support",
    says: "Drives that saw each stretch",
    stops: [1, 2, 5, 10, 20],
    labels: ["1", "2", "5", "10", "20 drives"],
    colours: FEW_TO_MANY,
    value: () => ["get", "drives"],
  },
  {
    id: "fresh",
    name: "Freshness",
    says: "Time since a drive last confirmed it",
    stops: [60, HOUR_S, DAY_S, 7 * DAY_S, 30 * DAY_S],
    labels: ["1 min", "1 h", "1 day", "7", "30 days"],
    colours: NEW_TO_OLD,
    value: (nowS) => ["-", nowS, ["get", "confirmed_s"]],
  },
  {
    id: "existence",
    name: "Existence",
    says: "Probability that the line is there",
    stops: [0.99, 0.95, 0.9, 0.7, 0.4],
    labels: ["99 %", "95", "90", "70", "40 %"],
    colours: GOOD_TO_BAD,
    value: () => ["get", "existence"],
  },
];

export function measure(id) {
  return MEASURES.find((each) => each.id === id);
}

/** The colour of a feature by a measure, as an expression; ages are counted from `nowS`. */
export function colourBy({ stops, colours, value }, nowS) {
  const pairs = stops.map((stop, index) => [stop, colours[index]]).sort(([a], [b]) => a - b);
  return ["interpolate", ["linear"], ["to-number", value(nowS), 0], ...pairs.flat()];
}

/** The layer that draws a measure along the lines of a source. */
export function measureLayer({ source, sourceLayer, shown, latitude, by, nowS }) {
  return {
    id: "measure",
    type: "line",
    source,
    ...(sourceLayer ? { "source-layer": sourceLayer } : {}),
    ...(shown ? { filter: shown } : {}),
    layout: { "line-join": "round", "line-cap": "butt" },
    paint: { "line-color": colourBy(by, nowS), "line-width": groundWidth(0.6, 2.2, latitude) },
  };
}
