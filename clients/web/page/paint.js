// How lanes look: the road as asphalt, each line as the paint that its category names.

import { metresPerPixel } from "./geometry.js";

/** The legend, in its order: what a kind of line is called and how it is painted. */
export const LEGEND = [
  { name: "White dashed", category: "white_dashed" },
  { name: "White solid", category: "white_solid" },
  { name: "White double", category: "double_white_solid" },
  { name: "Solid and dashed", category: "white_left_solid_right_dashed" },
  { name: "Yellow dashed", category: "yellow_dashed" },
  { name: "Yellow solid", category: "yellow_solid" },
  { name: "Yellow double", category: "double_yellow_solid" },
  { name: "Curb", category: "left_curb" },
  { name: "Not known", category: "unknown" },
];

/** The colours of the page's theme as it is now, from the style sheet's variables. */
export function theme() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    ground: colour("ground"),
    grid: colour("grid"),
    gridMajor: colour("grid-major"),
    verge: colour("verge"),
    asphalt: colour("asphalt"),
    ribbon: colour("ribbon"),
    white: colour("white-paint"),
    yellow: colour("yellow-paint"),
    curb: colour("curb"),
    unknown: colour("unknown-paint"),
    accent: colour("accent"),
  };
}

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
const PAINT = [0.16, 1.7];
/** Farther out than the first a road is a plain ribbon; nearer than the second its paint is seen in full. */
const [RIBBON_ZOOM, PAINT_ZOOM] = [14.5, 16.5];

/**
 * The layers that draw the source "lanes", bottom first, of the features that `shown` (a filter) lets through.
 * Breadths are metres on the ground at `latitude`, and never thinner than can be seen.
 */
export function laneLayers(colours, latitude, shown, chosen) {
  const breadth = ([metres, leastPixels], times = 1) => groundWidth(metres, leastPixels, latitude, times);
  const among = (categories) => ["in", CATEGORY, ["literal", categories]];
  const colour = [
    "case",
    ["==", ["slice", CATEGORY, 0, 6], "yellow"], colours.yellow,
    ["==", ["slice", CATEGORY, 0, 13], "double_yellow"], colours.yellow,
    among(CURB), colours.curb,
    ["==", CATEGORY, "unknown"], colours.unknown,
    colours.white,
  ];
  const certain = ["interpolate", ["linear"], ["get", "existence"], 0.2, 0.25, 0.9, 1];
  const visible = ["interpolate", ["linear"], ["zoom"], RIBBON_ZOOM, ["*", certain, 0.1], PAINT_ZOOM, certain];
  const road = ["interpolate", ["linear"], ["zoom"], RIBBON_ZOOM, colours.ribbon, PAINT_ZOOM, colours.asphalt];
  const layer = (id, filter, paint) => ({
    id,
    type: "line",
    source: "lanes",
    filter: filter ? ["all", shown, filter] : shown,
    layout: { "line-join": "round" },
    paint,
  });
  const line = (id, filter, paint) =>
    layer(id, filter, { "line-color": colour, "line-opacity": visible, "line-width": breadth(PAINT), ...paint });
  const beside = (categoriesToTheLeft, side) =>
    ["case", among(categoriesToTheLeft), -side, side];
  const dash = { "line-dasharray": [9, 11] };
  const apart = { "line-gap-width": breadth(PAINT, 0.9) };

  return [
    layer("verge", undefined, { "line-color": colours.verge, "line-width": breadth([9, 12]) }),
    layer("chosen", ["==", ["get", "session"], chosen], {
      "line-color": colours.accent, "line-width": breadth([6.6, 8]),
    }),
    layer("asphalt", undefined, { "line-color": road, "line-width": breadth([6, 5]) }),
    line("curb", among(CURB), { "line-width": breadth([0.32, 2.2]) }),
    line("unknown", ["==", CATEGORY, "unknown"], { "line-dasharray": [2, 3] }),
    line("solid", among(SINGLE.solid), {}),
    line("dashed", among(SINGLE.dashed), dash),
    line("double-solid", among(DOUBLE.solid), apart),
    line("double-dashed", among(DOUBLE.dashed), { ...dash, ...apart }),
    line("mixed-solid", among(MIXED), { "line-offset": groundOffset(PAINT, latitude, beside(LEFT_SOLID, 1)) }),
    line("mixed-dashed", among(MIXED), { ...dash, "line-offset": groundOffset(PAINT, latitude, beside(RIGHT_SOLID, 1)) }),
  ];
}

/** The layers that answer a click. */
export const CLICKABLE = [
  "curb", "unknown", "solid", "dashed", "double-solid", "double-dashed", "mixed-solid", "mixed-dashed",
];

/** A width in pixels that grows with zoom as `metres` do, from `leastPixels` on. */
function groundWidth(metres, leastPixels, latitude, times) {
  return zoomed(metres, leastPixels, latitude, (pixels) => pixels * times);
}

/** An offset to the right, in pixels, of one breadth times `side` (an expression: 1 right, -1 left). */
function groundOffset([metres, leastPixels], latitude, side) {
  return zoomed(metres, leastPixels, latitude, (pixels) => ["*", pixels, side]);
}

/**
 * Pixels double with each zoom, from where the least is reached to the last zoom. Farther out a line keeps thinning, four
 * times slower than the ground does, so that a road of many lines does not become one blot.
 */
function zoomed(metres, leastPixels, latitude, value) {
  const from = Math.min(Math.max(Math.log2(leastPixels * metresPerPixel(0, latitude) / metres), 1), 23);
  const [far, last] = [Math.max(from - 6, 0), 24];
  const pixels = (zoom) => leastPixels * 2 ** (zoom < from ? (zoom - from) / 4 : zoom - from);
  return ["interpolate", ["exponential", 2], ["zoom"], ...[far, from, last].flatMap((zoom) => [zoom, value(pixels(zoom))])];
}

/** A legend's swatch: a stretch of road with one line on it. */
export function swatch(category, colours) {
  const pair = /double|left_.*_right/.test(category);
  const dashes = { dashed: "9 5", solid: "none" };
  const kinds = /left_solid/.test(category) ? ["solid", "dashed"] : Array(2).fill(/dashed/.test(category) ? "dashed" : "solid");
  const stroke = /curb/.test(category) ? colours.curb : /yellow/.test(category) ? colours.yellow
    : category === "unknown" ? colours.unknown : colours.white;
  const width = /curb/.test(category) ? 4 : 2;
  const heights = pair ? [6, 10.5] : [8];
  const lines = heights.map((y, index) => {
    const dasharray = category === "unknown" ? "2 3" : dashes[kinds[index]];
    return `<path d="M0 ${y}H34" stroke="${stroke}" stroke-width="${width}" stroke-dasharray="${dasharray}"/>`;
  });
  return `<svg viewBox="0 0 34 16" aria-hidden="true">${lines.join("")}</svg>`;
}
