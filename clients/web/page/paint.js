// How lanes look: the road as asphalt, each line as the paint that its category names.
//
// Breadths and dashes are metres on the ground: 0.15 m of paint, dashes of 3 m with gaps of 6 m. Farther out than a breadth
// can be seen it is kept at a least number of pixels; dashes stay true for as long as they can be told apart.

import { dashesOf, metresPerPixel } from "./geometry.js";

/** The legend, in its order: what a kind of line is called and how it is painted. */
export const LEGEND = [
  { name: "White dashed", category: "white_dashed" },
  { name: "White solid", category: "white_solid" },
  { name: "White double", category: "double_white_solid" },
  { name: "Solid and dashed", category: "white_left_solid_right_dashed" },
  { name: "Yellow dashed", category: "yellow_dashed" },
  { name: "Yellow solid", category: "yellow_solid" },
  { name: "Yellow double", category: "double_yellow_solid" },
  { name: "Kerb, road edge", category: "left_curb" },
  { name: "Not known", category: "unknown" },
];

const CATEGORY = ["get", "category"];
const SINGLE = { solid: ["white_solid", "yellow_solid"], dashed: ["white_dashed", "yellow_dashed"] };
const DOUBLE = {
  solid: ["double_white_solid", "double_yellow_solid"],
  dashed: ["double_white_dashed", "double_yellow_dashed"],
};
const LEFT_SOLID = ["white_left_solid_right_dashed", "yellow_left_solid_right_dashed"];
const RIGHT_SOLID = ["white_left_dashed_right_solid", "yellow_left_dashed_right_solid"];
const MIXED = [...LEFT_SOLID, ...RIGHT_SOLID];
const CURB = ["left_curb", "right_curb"];

/** Breadth of one painted line, metres and the least pixels. */
const PAINT = [0.15, 1.5];
/** A dash and the gap after it, metres. */
const DASH_M = [3, 6];
/** The same of a line whose category is not known: nothing is claimed of its paint. */
const UNKNOWN_DASH_M = [0.6, 0.9];
/** First zoom at which tiles have dashes. */
export const DASHES_FROM = 15;
/** Farther out than the first a road is a plain ribbon; nearer than the second its paint is seen in full. */
const [RIBBON_ZOOM, PAINT_ZOOM] = [14.5, 16.2];

/** What is painted of the dashed ones of some features of lines. */
export function dashesOfLines(features) {
  const dashed = features.filter(({ properties }) => /dashed/.test(properties.category));
  return dashed.map((feature) => ({ ...feature, geometry: dashesOf(feature.geometry, ...DASH_M) }));
}

/**
 * The layers that draw lines by their paint, bottom first: those of `source` (a source's id, and its layer) that `shown` (a
 * filter, or nothing) lets through, at `latitude`. `dashed` is the source that has dashes cut, and the zoom from which on.
 */
export function paintLayers({ prefix = "", source, sourceLayer, dashed, shown, latitude, colours, strength = 1 }) {
  const among = (categories) => ["in", CATEGORY, ["literal", categories]];
  const colour = [
    "case",
    ["in", "yellow", CATEGORY], colours["yellow-paint"],
    among(CURB), colours.curb,
    ["==", CATEGORY, "unknown"], colours["unknown-paint"],
    colours["white-paint"],
  ];
  const certain = ["*", strength, ["interpolate", ["linear"], ["coalesce", ["get", "existence"], 1], 0.2, 0.3, 0.9, 1]];
  const visible = ["interpolate", ["linear"], ["zoom"], RIBBON_ZOOM, ["*", certain, 0.15], PAINT_ZOOM, certain];
  const breadth = ([metres, leastPixels], times = 1) => groundWidth(metres, leastPixels, latitude, times);
  const line = (id, filter, paint) => ({
    id: `${prefix}${id}`,
    type: "line",
    source,
    ...(sourceLayer ? { "source-layer": sourceLayer } : {}),
    minzoom: RIBBON_ZOOM,
    filter: shown ? ["all", shown, filter] : filter,
    layout: { "line-join": "round" },
    paint: { "line-color": colour, "line-opacity": visible, "line-width": breadth(PAINT), ...paint },
  });
  // A pattern begins anew in every tile: near the road, dashes come cut from the line.
  const far = { "line-dasharray": dashes(DASH_M, PAINT, latitude) };
  const strokes = (id, filter, paint) => [
    ...(dashed.minzoom > RIBBON_ZOOM ? [{ ...line(`${id}-far`, filter, { ...far, ...paint }), maxzoom: dashed.minzoom }] : []),
    { ...line(id, filter, paint), ...dashed },
  ];
  const apart = { "line-gap-width": breadth(PAINT, 0.8) };
  const beside = (categoriesToTheLeft) => groundOffset(PAINT, latitude, ["case", among(categoriesToTheLeft), -0.9, 0.9]);
  return [
    line("curb", among(CURB), { "line-width": breadth([0.3, 2]) }),
    line("unknown", ["==", CATEGORY, "unknown"], { "line-dasharray": dashes(UNKNOWN_DASH_M, PAINT, latitude) }),
    line("solid", among(SINGLE.solid), {}),
    ...strokes("dashed", among(SINGLE.dashed), {}),
    line("double-solid", among(DOUBLE.solid), apart),
    ...strokes("double-dashed", among(DOUBLE.dashed), apart),
    line("mixed-solid", among(MIXED), { "line-offset": beside(LEFT_SOLID) }),
    ...strokes("mixed-dashed", among(MIXED), { "line-offset": beside(RIGHT_SOLID) }),
  ];
}

/** The layers of the road below the paint, bottom first. */
export function roadLayers({ prefix = "", source, sourceLayer, shown, latitude, colours }) {
  const layer = (id, rest) => ({
    id: `${prefix}${id}`,
    type: "line",
    source,
    ...(sourceLayer ? { "source-layer": sourceLayer } : {}),
    ...(shown ? { filter: shown } : {}),
    layout: { "line-join": "round", "line-cap": "round" },
    ...rest,
  });
  const wide = (metres, leastPixels) => groundWidth(metres, leastPixels, latitude);
  const road = ["interpolate", ["linear"], ["zoom"], RIBBON_ZOOM, colours.ribbon, PAINT_ZOOM, colours.asphalt];
  return [
    layer("verge", { minzoom: RIBBON_ZOOM, paint: { "line-color": colours.verge, "line-width": wide(7, 8) } }),
    layer("asphalt", { paint: { "line-color": road, "line-width": wide(4.8, 2.2) } }),
  ];
}

/** A width in pixels that grows with zoom as `metres` do, from `leastPixels` on. */
export function groundWidth(metres, leastPixels, latitude, times = 1) {
  return zoomed(metres, leastPixels, latitude, (pixels) => pixels * times);
}

/** An offset to the right, in pixels, of one breadth times `side` (an expression: 1 right, -1 left). */
function groundOffset([metres, leastPixels], latitude, side) {
  return zoomed(metres, leastPixels, latitude, (pixels) => ["*", pixels, side]);
}

/** Dashes in multiples of the breadth that a line has at each whole zoom: MapLibre scales them in between. */
function dashes([dashM, gapM], [metres, leastPixels], latitude) {
  const at = (zoom) => {
    const breadth = metresPerPixel(zoom, latitude) * pixelsAt(zoom, metres, leastPixels, latitude);
    // Below a few pixels they would run into each other.
    const scale = Math.max(1, (4 * metresPerPixel(zoom, latitude)) / (dashM + gapM));
    return ["literal", [(scale * dashM) / breadth, (scale * gapM) / breadth]];
  };
  const zooms = Array.from({ length: 10 }, (_, index) => 14 + index);
  return ["step", ["zoom"], at(13), ...zooms.flatMap((zoom) => [zoom, at(zoom)])];
}

/**
 * Pixels double with each zoom, from where the least is reached to the last zoom. Farther out a line keeps thinning, four
 * times slower than the ground does, so that a road of many lines does not become one blot.
 */
function pixelsAt(zoom, metres, leastPixels, latitude) {
  const from = leastZoom(metres, leastPixels, latitude);
  return leastPixels * 2 ** (zoom < from ? (zoom - from) / 4 : zoom - from);
}

/** The zoom at which `metres` are `leastPixels`. */
function leastZoom(metres, leastPixels, latitude) {
  return Math.min(Math.max(Math.log2((leastPixels * metresPerPixel(0, latitude)) / metres), 1), 23);
}

function zoomed(metres, leastPixels, latitude, value) {
  const from = leastZoom(metres, leastPixels, latitude);
  const stops = [Math.max(from - 6, 0), from, 24];
  return [
    "interpolate", ["exponential", 2], ["zoom"],
    ...stops.flatMap((zoom) => [zoom, value(pixelsAt(zoom, metres, leastPixels, latitude))]),
  ];
}

/** A legend's swatch: a stretch of road with one line on it. */
export function swatch(category, colours) {
  const pair = /double|left_.*_right/.test(category);
  const stretch = { dashed: "9 5", solid: "none" };
  const kinds = /left_solid/.test(category) ? ["solid", "dashed"] : Array(2).fill(/dashed/.test(category) ? "dashed" : "solid");
  const stroke = /curb/.test(category) ? colours.curb : /yellow/.test(category) ? colours["yellow-paint"]
    : category === "unknown" ? colours["unknown-paint"] : colours["white-paint"];
  const width = /curb/.test(category) ? 4 : 2;
  const heights = pair ? [6, 10.5] : [8];
  const lines = heights.map((y, index) => {
    const dasharray = category === "unknown" ? "2 3" : stretch[kinds[index]];
    return `<path d="M0 ${y}H34" stroke="${stroke}" stroke-width="${width}" stroke-dasharray="${dasharray}"/>`;
  });
  return `<svg class="swatch" viewBox="0 0 34 16" aria-hidden="true">${lines.join("")}</svg>`;
}

/** What a category is called in a sentence. */
export function categoryName(category) {
  return String(category).replaceAll("_", " ").replace(/\b(left|right) curb/, "$1 kerb");
}
