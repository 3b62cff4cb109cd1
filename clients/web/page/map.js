// The map: MapLibre with the lines of the shared map as vector tiles, and what lies over them.

import * as maplibre from "./maplibre-gl.mjs";
import { joinBoxes } from "./geometry.js";
import { Grid } from "./grid.js";
import { TILES_FROM, isClickable, layersOf } from "./layers.js";
import { dashesOfLines } from "./paint.js";
import { colours, moving, onTheme } from "./theme.js";
import { vehicleIcons } from "./vehicles.js";

const EMPTY = { type: "FeatureCollection", features: [] };
/** Full precision at every zoom: a lane is drawn where it lies, not where a tile's grid has a place for it. */
const EXACT = { type: "geojson", maxzoom: 22, tolerance: 0, data: EMPTY };
/** Last zoom of vector tiles; farther in, theirs are drawn larger. */
const TILES_TO = 20;
/** How far from a line a click still means it, pixels. */
const REACH_PX = 8;
/** Part of a chord between two places at which a line is looked for. */
const STEP_OF_CHORD = 1 / 16;

export class LaneMap {
  /** Resolves once the style is drawn. */
  ready;
  /** MapLibre's own. */
  map;
  #view = { layer: "paint", latitude: 0, nowS: Date.now() / 1000 };
  #layers = [];
  #grid = new Grid();
  #server;
  /** The revision of the map that tiles are asked for; the newest where there is none. */
  #revision;

  /**
   * `on.moved()` is called when the user moves the map, `on.dragged()` when by dragging it, `on.clicked(feature, place)` when
   * it is clicked, `on.pointed(place)` when the pointer moves over it, `on.failed(error)` when a tile cannot be had.
   */
  constructor(container, server, on) {
    this.#server = server;
    this.#layers = layersOf(this.#view, colours());
    this.map = new maplibre.Map({
      container,
      hash: "at",
      style: {
        version: 8,
        sources: {
          lanes: {
            type: "vector", tiles: [`${server.address("tiles/lanes/")}{z}/{x}/{y}`],
            minzoom: TILES_FROM, maxzoom: TILES_TO,
          },
          cells: EXACT, drive: EXACT, "drive-dashes": EXACT, trace: EXACT, changes: EXACT, events: EXACT, truth: EXACT, ruler: EXACT, vehicles: EXACT, grid: EXACT,
        },
        layers: this.#layers,
      },
      center: [0, 0],
      zoom: 2,
      maxZoom: 23,
      maxPitch: 70,
      renderWorldCopies: false,
      attributionControl: false,
      fadeDuration: 0,
      // A tile that is out of sight would not be told that it changed.
      maxTileCacheSize: 0,
      maxTileCacheZoomLevels: 0,
      transformRequest: (url, kind) => (kind === "Tile" ? this.#tileRequest(url) : { url }),
    });
    this.map.addControl(new maplibre.NavigationControl({ visualizePitch: true }), "top-right");
    this.map.addControl(new maplibre.ScaleControl({ maxWidth: 120 }), "bottom-right");
    this.map.on("error", ({ error }) => on.failed(error));
    this.map.on("move", ({ originalEvent }) => originalEvent && on.moved());
    this.map.on("dragstart", on.dragged);
    this.map.on("click", ({ point, lngLat }) => on.clicked(this.lineAt(point), [lngLat.lng, lngLat.lat]));
    this.map.on("mousemove", ({ point, lngLat }) => {
      on.pointed([lngLat.lng, lngLat.lat]);
      this.map.getCanvas().style.cursor = this.busy ? "crosshair" : this.lineAt(point) ? "pointer" : "";
    });
    onTheme(() => this.show({}));
    this.ready = this.map.once("load").then(() => {
      for (const [name, image] of vehicleIcons()) this.map.addImage(name, image, { pixelRatio: 2 });
      this.show({});
      this.#moved();
      this.map.on("move", () => this.#moved());
    });
  }

  /** Shows what is given in place of what was shown before: see `layersOf`. */
  show(change) {
    this.#view = { ...this.#view, ...change };
    this.#apply(layersOf(this.#view, colours()));
  }

  /** Puts features into a source: "cells", "drive", "trace", "changes", "events", "truth", "ruler" or "vehicles". */
  put(source, features) {
    this.map.getSource(source).setData({ type: "FeatureCollection", features });
    if (source === "drive") this.put("drive-dashes", dashesOfLines(features));
  }

  /** Shows the map as it was at a revision, or as it is now. */
  goTo(revision) {
    if (revision === this.#revision) return;
    this.#revision = revision;
    this.reload();
  }

  /** Fetches all tiles again that are seen; what is drawn stays until they are there. */
  reload() {
    this.map.refreshTiles("lanes");
  }

  /** Fetches those tiles again that are seen and touch one of some boxes. */
  reloadWithin(boxes) {
    const seen = this.#tilesWithin(boxes);
    if (seen.length > 0) this.map.refreshTiles("lanes", seen);
    return seen.length;
  }

  /** Flies to a box; without one it stays, and says so. */
  look(box, durationMs, maxZoom = 19) {
    if (!box) return false;
    const camera = this.map.cameraForBounds(box, { padding: this.padding(), maxZoom });
    // Where little of it would be out of sight, roads are shown rather than squares.
    if (camera.zoom > TILES_FROM - 0.7) camera.zoom = Math.max(camera.zoom, TILES_FROM);
    const [here, there] = [this.map.project(this.map.getCenter()), this.map.project(camera.center)];
    const isThere = Math.abs(camera.zoom - this.map.getZoom()) < 0.02 && Math.hypot(here.x - there.x, here.y - there.y) < 2;
    if (!isThere) this.map.flyTo({ ...camera, duration: moving(durationMs) });
    return true;
  }

  /** Whether a box lies wholly in the free part of the map. */
  holds(box) {
    if (!box) return true;
    const { clientWidth, clientHeight } = this.map.getContainer();
    const free = this.padding();
    return [[box[0], box[1]], [box[2], box[3]]].map((corner) => this.map.project(corner)).every(({ x, y }) =>
      x > free.left - 40 && x < clientWidth - 10 && y > 10 && y < clientHeight - free.bottom + 40);
  }

  /** Whether a box `[west, south, east, north]` touches the view. */
  sees([west, south, east, north]) {
    const view = this.map.getBounds();
    return west > east || (west <= view.getEast() && view.getWest() <= east && south <= view.getNorth() && view.getSouth() <= north);
  }

  /** Keeps a place in the middle of the free part of the map. */
  centre(place, durationMs = 1000) {
    const zoom = Math.max(this.map.getZoom(), 18);
    const { top, right, bottom, left } = this.padding();
    const offset = [(left - right) / 2, (top - bottom) / 2];
    this.map.easeTo({ center: place, zoom, offset, duration: moving(durationMs), easing: (part) => part });
  }

  /** A line at a pixel, or within a finger's breadth of it. */
  lineAt({ x, y }) {
    const around = [[x - REACH_PX, y - REACH_PX], [x + REACH_PX, y + REACH_PX]];
    const paint = this.map.queryRenderedFeatures(around, { layers: this.#clickable() });
    const named = paint.filter(({ properties }) => properties.lane);
    return named.find(({ layer }) => layer.id !== "asphalt") ?? named[0];
  }

  /** Resolves when the map stands still and all lines are on the screen; vehicles may move. */
  async settled() {
    for (;;) {
      this.map.triggerRepaint();
      await this.map.once("render");
      const loaded = ["lanes", "drive", "drive-dashes", "trace"].every((source) => this.map.isSourceLoaded(source));
      if (loaded && !this.map.isMoving()) return;
    }
  }

  /** The lines on the screen, by their feature ids; of the chosen drive where `own`. */
  linesOnScreen(own = false) {
    const layers = this.#clickable(own ? "drive-" : "");
    const features = this.map.queryRenderedFeatures({ layers });
    return [...new Set(features.map(({ id, properties }) => properties.lane_feature ?? id ?? `${properties.session}.${properties.lane}`))];
  }

  /** A pixel on some line that nothing covers; waits for the map to stand still. */
  async somePointOfALine() {
    await this.settled();
    const { left, right, top, bottom } = this.padding();
    const { clientWidth, clientHeight } = this.map.getContainer();
    const free = [[left, top], [clientWidth - right, clientHeight - bottom]];
    for (const { geometry, properties } of this.map.queryRenderedFeatures(free, { layers: this.#clickable() })) {
      if (!properties.lane) continue;
      for (const line of geometry.type === "LineString" ? [geometry.coordinates] : geometry.coordinates) {
        const pixels = line.map((place) => this.map.project(place));
        // A straight line may cross the free part with no vertex in it.
        for (let at = 0; at < pixels.length - 1; at += STEP_OF_CHORD) {
          const [from, to, share] = [pixels[Math.floor(at)], pixels[Math.floor(at) + 1], at % 1];
          const [x, y] = [from.x + (to.x - from.x) * share, from.y + (to.y - from.y) * share];
          if (x > free[0][0] && x < free[1][0] && y > free[0][1] && y < free[1][1]) return [x, y];
        }
      }
    }
    return undefined;
  }

  /** Room for the panels: beside them on a desk, above them on a phone. */
  padding() {
    const box = (id) => document.getElementById(id).getBoundingClientRect();
    const [panel, card, bar, banner] = [box("panel"), box("card"), box("bar"), box("banner")];
    const { innerWidth, innerHeight } = window;
    if (panel.width > innerWidth * 0.8) {
      const top = Math.min(...[panel, card, bar].filter(({ height }) => height > 0).map((each) => each.top));
      return { top: banner.bottom + 50, right: 30, bottom: Math.min(innerHeight - top + 20, innerHeight * 0.7), left: 30 };
    }
    return {
      top: banner.bottom + 50, bottom: bar.height + 50,
      left: panel.right + 40, right: card.width > 0 ? innerWidth - card.left + 30 : 60,
    };
  }

  #clickable(prefix = "") {
    return this.#layers.map((layer) => layer.id).filter((id) => id.startsWith(prefix) && isClickable({ id: id.slice(prefix.length) }));
  }

  #tileRequest(url) {
    const address = this.#revision === undefined ? url : `${url}?revision=${this.#revision}`;
    return { url: address, headers: this.#server.headers() };
  }

  /** The tiles on the screen that touch one of some boxes. */
  #tilesWithin(boxes) {
    const zoom = Math.min(Math.max(Math.floor(this.map.getZoom()), TILES_FROM), TILES_TO);
    const { west, south, east, north } = edges(this.map.getBounds());
    const found = new Map();
    // Also those of the zooms around: a tilted map shows coarser ones far away, a zooming one still has others.
    for (let z = Math.max(zoom - 4, TILES_FROM); z <= Math.min(zoom + 1, TILES_TO); z += 1) {
      for (const box of boxes) {
        const [x0, y0] = tileAt(Math.max(box[0], west), Math.min(box[3], north), z);
        const [x1, y1] = tileAt(Math.min(box[2], east), Math.max(box[1], south), z);
        for (let x = x0; x <= x1; x += 1) {
          for (let y = y0; y <= y1; y += 1) found.set(`${z}/${x}/${y}`, { z, x, y });
        }
      }
    }
    return [...found.values()];
  }

  /** Changes the layers that differ from those that are there. */
  #apply(wanted) {
    if (!this.map.style?._loaded) return;
    const before = new Map(this.#layers.map((layer) => [layer.id, layer]));
    const ids = new Set(wanted.map(({ id }) => id));
    for (const { id } of this.#layers) {
      if (!ids.has(id)) this.map.removeLayer(id);
    }
    let above;
    for (const layer of [...wanted].reverse()) {
      const old = before.get(layer.id);
      if (!old) this.map.addLayer(layer, above);
      else this.#change(old, layer);
      above = layer.id;
    }
    this.#layers = wanted;
  }

  #change(old, layer) {
    if (differ(old.filter, layer.filter)) this.map.setFilter(layer.id, layer.filter ?? null);
    for (const [name, value] of Object.entries(layer.paint ?? {})) {
      if (differ(old.paint?.[name], value)) this.map.setPaintProperty(layer.id, name, value);
    }
  }

  #moved() {
    const grid = this.#grid.cover(this.map);
    if (grid) this.map.getSource("grid").setData(grid);
    const latitude = this.map.getCenter().lat;
    if (Math.abs(latitude - this.#view.latitude) > 2) this.show({ latitude });
  }
}

/** The smallest box around boxes that are there. */
export function around(boxes) {
  return joinBoxes(boxes.filter(Boolean));
}

function differ(one, other) {
  return JSON.stringify(one) !== JSON.stringify(other);
}

function edges(bounds) {
  return { west: bounds.getWest(), south: bounds.getSouth(), east: bounds.getEast(), north: bounds.getNorth() };
}

function tileAt(longitude, latitude, zoom) {
  const most = 2 ** zoom;
  const clamped = (Math.min(Math.max(latitude, -85), 85) * Math.PI) / 180;
  const x = ((longitude + 180) / 360) * most;
  const y = (0.5 - Math.asinh(Math.tan(clamped)) / (2 * Math.PI)) * most;
  return [x, y].map((value) => Math.min(Math.max(Math.floor(value), 0), most - 1));
}
