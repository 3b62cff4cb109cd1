// All that is drawn, from the ground up: which layers there are for what the page is to show.

import { gridLayers } from "./grid.js";
import { measure, measureLayer } from "./measures.js";
import { DASHES_FROM, groundWidth, paintLayers, roadLayers } from "./paint.js";

/** First zoom of vector tiles: farther out, the cells of the map are drawn as squares. */
export const TILES_FROM = 12;
/** First zoom at which tiles tell what is known along a line. */
const STRETCHES_FROM = 15;

const SHARED = { source: "lanes", sourceLayer: "lanes" };
const DASHED = { source: "lanes", "source-layer": "dashes", minzoom: DASHES_FROM };
const NONE = ["==", ["literal", 1], 0];

/**
 * The layers, bottom first. `view` is what the page shows: `layer` ("paint", "change" or a measure), `lane` (the name of the
 * chosen line), `event` (the id of the chosen event), `drive` (`{ local }` of the chosen drive), `latitude`, `nowS`.
 */
export function layersOf(view, colours) {
  const { latitude } = view;
  const alone = view.drive !== undefined;
  const shared = view.drive?.local ? NONE : undefined;
  const road = { ...SHARED, shown: shared, latitude, colours };
  const by = measure(view.layer);
  const muted = alone || view.layer === "change";
  return [
    { id: "ground", type: "background", paint: { "background-color": colours.ground } },
    ...gridLayers(colours),
    ...cellLayers(colours, shared),
    ...roadLayers(road),
    ...(alone ? roadLayers({ prefix: "drive-", source: "drive", latitude, colours: { ...colours, ribbon: colours.accent } }) : []),
    chosenLayer(view, colours),
    ...(by && !alone ? measureLayers(by, view, shared) : paintLayers({ ...road, dashed: DASHED, strength: muted ? 0.25 : 1 })),
    ...(view.layer === "change" && !alone ? [...changeLayers(colours, latitude), ...eventLayers(colours, view)] : []),
    ...(alone ? [
      ...paintLayers({ prefix: "drive-", source: "drive", dashed: { source: "drive-dashes" }, latitude, colours }),
      traceLayer(colours),
    ] : []),
    truthLayer(colours, latitude),
    ...rulerLayers(colours),
    ...vehicleLayers(colours, view.drive),
  ];
}

/** The layers that answer a click, of those that are drawn. */
export const isClickable = ({ id }) => /^(curb|unknown|solid|dashed|double|mixed|measure|change|event|asphalt)/.test(id);

function measureLayers(by, view, shown) {
  const layer = (id, sourceLayer, zooms) => ({
    ...measureLayer({ source: "lanes", sourceLayer, shown, latitude: view.latitude, by, nowS: view.nowS }), id, ...zooms,
  });
  return [
    layer("measure-far", "lanes", { maxzoom: STRETCHES_FROM }),
    layer("measure", "stretches", { minzoom: STRETCHES_FROM }),
  ];
}

function cellLayers(colours, shown) {
  const cells = { source: "cells", maxzoom: TILES_FROM + 0.5, ...(shown ? { filter: shown } : {}) };
  const share = ["interpolate", ["linear"], ["get", "line_km"], 0, 0.15, 10, 0.45, 60, 1];
  const fading = [
    "interpolate", ["linear"], ["zoom"],
    TILES_FROM - 0.7, ["*", 0.8, share], TILES_FROM, ["*", 0.12, share], TILES_FROM + 0.5, 0,
  ];
  return [
    { id: "cells", type: "fill", ...cells, paint: { "fill-color": colours.ribbon, "fill-opacity": fading } },
    { id: "cells-edge", type: "line", ...cells, paint: { "line-color": colours.ground, "line-width": 1, "line-opacity": fading } },
  ];
}

function chosenLayer(view, colours) {
  return {
    id: "chosen",
    type: "line",
    source: "lanes",
    "source-layer": "lanes",
    minzoom: 14,
    filter: view.lane === undefined ? NONE : ["==", ["get", "lane"], view.lane],
    layout: { "line-join": "round", "line-cap": "round" },
    paint: { "line-color": colours.chosen, "line-opacity": 0.75, "line-width": groundWidth(1.3, 7, view.latitude) },
  };
}

const KIND = ["get", "kind"];
const colourOfKind = (colours) => ["match", KIND, "vanished", colours.vanished, "moved", colours.moved, "repainted", colours.repainted, colours.appeared];

/** Where the map is another one than it was. */
function changeLayers(colours, latitude) {
  const line = (id, filter, paint) => ({
    id, type: "line", source: "changes", filter,
    layout: { "line-join": "round", "line-cap": "butt" },
    paint: { "line-color": colourOfKind(colours), "line-width": groundWidth(0.3, 1.4, latitude), "line-opacity": 0.8, ...paint },
  });
  return [
    line("change", ["!=", KIND, "vanished"], {}),
    line("change-gone", ["==", KIND, "vanished"], { "line-dasharray": [2, 1.4] }),
  ];
}

/** What happened to the road: the surer, the stronger. */
function eventLayers(colours, { latitude, event }) {
  const [colour, sure] = [colourOfKind(colours), ["interpolate", ["linear"], ["get", "probability"], 0.5, 0.35, 0.95, 1]];
  const chosen = (yes, no) => ["case", ["==", ["get", "event"], event ?? ""], yes, no];
  const line = (id, more, paint) => ({
    id, type: "line", source: "events", filter: ["all", ["==", ["geometry-type"], "LineString"], ...more],
    layout: { "line-join": "round", "line-cap": "butt" },
    paint: { "line-color": colour, "line-opacity": sure, "line-width": groundWidth(0.8, 4, latitude), ...paint },
  });
  return [
    line("event-edge", [], { "line-color": chosen(colours.chosen, colours.ground), "line-width": groundWidth(1.4, 7, latitude), "line-opacity": 0.8 }),
    line("event", [["!=", KIND, "vanished"]], {}),
    line("event-gone", [["==", KIND, "vanished"]], { "line-dasharray": [1.6, 0.9] }),
    {
      id: "event-mark", type: "circle", source: "events", maxzoom: 17, filter: ["==", ["geometry-type"], "Point"],
      paint: {
        "circle-radius": ["interpolate", ["linear"], ["zoom"], 12, 4, 16, 7], "circle-color": colour, "circle-opacity": sure,
        "circle-stroke-color": chosen(colours.chosen, colours.card), "circle-stroke-width": chosen(3, 2),
      },
    },
  ];
}

function traceLayer(colours) {
  return {
    id: "trace", type: "line", source: "trace",
    layout: { "line-join": "round", "line-cap": "round" },
    paint: { "line-color": colours.accent, "line-width": 2.5, "line-opacity": 0.9, "line-dasharray": [0.2, 2] },
  };
}

function truthLayer(colours, latitude) {
  return {
    id: "truth", type: "line", source: "truth",
    layout: { "line-join": "round" },
    paint: { "line-color": colours.truth, "line-width": groundWidth(0.06, 1.4, latitude), "line-opacity": 0.95 },
  };
}

function rulerLayers(colours) {
  return [
    {
      id: "ruler", type: "line", source: "ruler", filter: ["==", ["geometry-type"], "LineString"],
      paint: { "line-color": colours.accent, "line-width": 2, "line-dasharray": [2, 1.5] },
    },
    {
      id: "ruler-ends", type: "circle", source: "ruler", filter: ["==", ["geometry-type"], "Point"],
      paint: {
        "circle-radius": 4.5, "circle-color": colours.card, "circle-stroke-color": colours.accent, "circle-stroke-width": 2.5,
      },
    },
  ];
}

function vehicleLayers(colours, drive) {
  const chosen = ["==", ["get", "chosen"], true];
  return [
    {
      id: "vehicle-halo", type: "circle", source: "vehicles", filter: chosen,
      paint: {
        "circle-radius": 19, "circle-color": colours.accent, "circle-opacity": 0.22,
        "circle-stroke-color": colours.accent, "circle-stroke-width": 1.5,
      },
    },
    {
      id: "vehicles", type: "symbol", source: "vehicles",
      ...(drive ? { filter: chosen } : {}),
      layout: {
        "icon-image": ["get", "icon"],
        "icon-rotate": ["get", "heading"],
        "icon-rotation-alignment": "map",
        "icon-pitch-alignment": "map",
        "icon-allow-overlap": true,
        "icon-ignore-placement": true,
        "icon-size": ["interpolate", ["linear"], ["zoom"], 12, 0.5, 18, 0.85, 22, 1.6],
      },
    },
  ];
}
