// The map: MapLibre with the lanes, the vehicles and the grid as its sources.

import * as maplibre from "./maplibre-gl.mjs";
import { joinBoxes, lengthOf, placeLocal, placeLocalBox, placeLocalGeometry } from "./geometry.js";
import { Grid, gridLayers } from "./grid.js";
import { CLICKABLE, laneLayers, theme } from "./paint.js";
import { SESSION_COLOURS, colourIndex } from "./panel.js";

const EMPTY = { type: "FeatureCollection", features: [] };
/** Full precision at every zoom: a lane is drawn where it lies, not where a tile's grid has a place for it. */
const EXACT = { type: "geojson", maxzoom: 24, tolerance: 0, data: EMPTY };
/** Farther out than this a road is thinner than a pixel, and its lanes are not fetched. */
const FARTHEST_ZOOM = 8;
/** How far from a line a click still means it, pixels. */
const REACH_PX = 6;

export class LaneMap {
  /** Resolves once the style is drawn. */
  ready;
  /** What is drawn, by session and by cell: the keys of its lines and their length together. */
  #drawn = new Map();
  #chosen;
  #local = false;
  #latitude = 0;
  #grid = new Grid();
  #map;

  /** `on.moved()` is called when the user moves the map, `on.dragged()` when by dragging it. */
  constructor(container, on) {
    const colours = theme();
    this.#map = new maplibre.Map({
      container,
      style: {
        version: 8,
        sources: { lanes: { ...EXACT, promoteId: "key" }, vehicles: EXACT, grid: EXACT },
        layers: [{ id: "ground", type: "background" }, ...this.#layers(colours)],
      },
      center: [0, 0],
      zoom: 2,
      maxZoom: 23,
      maxPitch: 70,
      renderWorldCopies: false,
      attributionControl: false,
      fadeDuration: 0,
    });
    this.#map.addControl(new maplibre.ScaleControl({ maxWidth: 140 }), "bottom-right");
    this.#map.addControl(new maplibre.NavigationControl({ visualizePitch: true }), "top-right");
    this.#map.on("move", ({ originalEvent }) => originalEvent && on.moved());
    this.#map.on("dragstart", on.dragged);
    this.#map.on("click", (event) => this.#explain(event));
    this.#map.on("mousemove", ({ point }) => {
      this.#map.getCanvas().style.cursor = this.#lineAt(point) ? "pointer" : "";
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#restyle());
    this.ready = this.#map.once("load").then(() => {
      SESSION_COLOURS.forEach((colour, index) => {
        this.#map.addImage(`vehicle-${index}`, arrow(colour), { pixelRatio: 2 });
      });
      this.#restyle();
      this.#moved();
      this.#map.on("move", () => this.#moved());
    });
  }

  /** Draws a session's lanes in place of those drawn before; hands over only that session's lines. */
  showLanes(session, collection) {
    const features = collection.features.map(({ geometry, properties, id }) => ({
      type: "Feature",
      geometry: session.georeferenced ? geometry : placeLocalGeometry(geometry),
      properties: { ...properties, key: String(id), local: !session.georeferenced },
    }));
    this.#show(session.id, features);
  }

  /** Draws a cell of the shared map in place of what was drawn of it before. */
  showCell(cell, collection) {
    this.#show(cell.id, collection.features.map(({ geometry, properties, id }) => ({
      type: "Feature",
      geometry,
      properties: { ...properties, sigma_m: properties.lateral_sigma_m, key: String(id), shared: true, local: false },
    })));
  }

  #show(id, features) {
    const keys = new Set(features.map((feature) => feature.properties.key));
    const remove = (this.#drawn.get(id)?.keys ?? []).filter((key) => !keys.has(key));
    const metres = features.reduce((total, { geometry }) => total + lengthOf(geometry), 0);
    this.#drawn.set(id, { keys: [...keys], metres });
    this.#map.getSource("lanes").updateData({ remove, add: features });
  }

  /** Removes what was drawn of a session. */
  forget(id) {
    this.#map.getSource("lanes").updateData({ remove: this.#drawn.get(id)?.keys ?? [] });
    this.#drawn.delete(id);
  }

  showVehicles(sessions) {
    const features = sessions.filter((session) => session.vehicle).map((session) => ({
      type: "Feature",
      geometry: { type: "Point", coordinates: vehiclePosition(session) },
      properties: {
        session: session.id,
        local: !session.georeferenced,
        heading: session.vehicle.heading_deg,
        icon: `vehicle-${colourIndex(session)}`,
        live: session.state === "live",
      },
    }));
    this.#map.getSource("vehicles").setData({ type: "FeatureCollection", features });
  }

  /**
   * Draws what the chosen session alone has seen in place of the shared map, which is drawn where none is chosen; of a
   * `local` one the vehicle, too, is drawn alone, for it shares no frame with the others.
   */
  choose(id, local) {
    if (this.#chosen === id && this.#local === local) return;
    [this.#chosen, this.#local] = [id, local];
    this.#restyle();
  }

  /** Flies to a box around sessions; whether they have one. */
  look(sessions, durationMs) {
    const box = boxOf(sessions);
    if (!box) return false;
    this.#map.fitBounds(box, { padding: this.#padding(), maxZoom: 19, duration: smooth(durationMs) });
    return true;
  }

  /** Whether a box around sessions lies wholly in the free part of the map. */
  holds(sessions) {
    const box = boxOf(sessions);
    if (!box) return true;
    const { clientWidth, clientHeight } = this.#map.getContainer();
    const free = this.#padding();
    return [[box[0], box[1]], [box[2], box[3]]].map((corner) => this.#map.project(corner)).every(({ x, y }) =>
      x > free.left - 40 && x < clientWidth - 10 && y > 10 && y < clientHeight - free.bottom + 40);
  }

  /** Whether a session's lanes can be seen: near enough, and within the view. */
  sees(session) {
    if (!session.bbox || this.#map.getZoom() < FARTHEST_ZOOM) return false;
    const [west, south, east, north] = session.georeferenced ? session.bbox : placeLocalBox(session.bbox);
    const view = this.#map.getBounds();
    return west > east || (west <= view.getEast() && view.getWest() <= east
      && south <= view.getNorth() && view.getSouth() <= north);
  }

  /** Keeps a session's vehicle in the middle of the free part of the map. */
  centre(session) {
    if (!session?.vehicle) return;
    const zoom = Math.max(this.#map.getZoom(), 18);
    const { top, right, bottom, left } = this.#padding();
    const offset = [(left - right) / 2, (top - bottom) / 2];
    this.#map.easeTo({ center: vehiclePosition(session), zoom, offset, duration: smooth(1000), easing: (part) => part });
  }

  /** What is drawn: the length of all lines, metres, and the number of features on the screen. */
  get state() {
    const metres = [...this.#drawn.values()].reduce((total, session) => total + session.metres, 0);
    return { metres, rendered: this.#onScreen().length };
  }

  /** Resolves when the map stands still and all that it was given is on the screen. */
  async settled() {
    this.#map.triggerRepaint();
    await this.#map.once("idle");
  }

  /** The sessions that have a line on the screen. */
  sessionsOnScreen() {
    return [...new Set(this.#onScreen().map((feature) => feature.properties.session).filter(Boolean))].sort();
  }

  /** A pixel on some line that no panel covers; waits for the map to stand still. */
  async somePointOfALine() {
    await this.settled();
    const { left, right, top, bottom } = this.#padding();
    const { clientWidth, clientHeight } = this.#map.getContainer();
    const free = [[left, top], [clientWidth - right, clientHeight - bottom]];
    for (const { geometry } of this.#map.queryRenderedFeatures(free, { layers: CLICKABLE })) {
      for (const place of geometry.type === "LineString" ? geometry.coordinates : geometry.coordinates.flat()) {
        const { x, y } = this.#map.project(place);
        if (x > free[0][0] && x < free[1][0] && y > free[0][1] && y < free[1][1]) return [x, y];
      }
    }
    return undefined;
  }

  #onScreen() {
    return this.#map.queryRenderedFeatures({ layers: CLICKABLE });
  }

  /** Room for the panel, beside it on a desk and above it on a phone, and for the banner. */
  #padding() {
    const { width, height } = document.getElementById("panel").getBoundingClientRect();
    const banner = document.getElementById("local-banner").getBoundingClientRect();
    const phone = width > innerWidth * 0.8;
    return { top: banner.bottom + 60, right: 60, bottom: phone ? height + 30 : 50, left: phone ? 40 : width + 50 };
  }

  #layers(colours) {
    const ofChosen = ["==", ["get", "session"], this.#chosen ?? ""];
    const shown = this.#chosen === undefined ? ["==", ["get", "shared"], true] : ofChosen;
    return [
      ...gridLayers(colours),
      ...laneLayers(colours, this.#latitude, shown, this.#chosen ?? ""),
      ...vehicleLayers(this.#local ? ofChosen : ["!", ["get", "local"]]),
    ];
  }

  #restyle() {
    const colours = theme();
    this.#map.setPaintProperty("ground", "background-color", colours.ground);
    for (const layer of this.#layers(colours)) {
      if (layer.filter) this.#map.setFilter(layer.id, layer.filter);
      for (const [name, value] of Object.entries(layer.paint ?? {})) this.#map.setPaintProperty(layer.id, name, value);
    }
  }

  #moved() {
    const grid = this.#grid.cover(this.#map);
    if (grid) this.#map.getSource("grid").setData(grid);
    const latitude = this.#map.getCenter().lat;
    if (Math.abs(latitude - this.#latitude) > 2) {
      this.#latitude = latitude;
      this.#restyle();
    }
  }

  /** A line at a pixel, or within a finger's breadth of it. */
  #lineAt({ x, y }) {
    const around = [[x - REACH_PX, y - REACH_PX], [x + REACH_PX, y + REACH_PX]];
    return this.#map.queryRenderedFeatures(around, { layers: CLICKABLE })[0];
  }

  #explain({ point, lngLat }) {
    const properties = this.#lineAt(point)?.properties;
    if (!properties) return;
    const figures = {
      ...(properties.shared ? { drives: properties.drives, cell: properties.cell } : { session: properties.session }),
      existence: `${Math.round(properties.existence * 100)} %`,
      "lateral sigma": `${Math.round(properties.sigma_m * 100)} cm`,
      observations: properties.observations,
      "last seen": properties.last_seen.replace("T", " ").slice(0, 19),
    };
    const title = document.createElement("h3");
    const name = properties.shared ? "Line" : `Lane ${properties.lane}`;
    title.textContent = `${name}: ${properties.category.replaceAll("_", " ")}`;
    const table = document.createElement("table");
    for (const [name, value] of Object.entries(figures)) {
      const row = table.insertRow();
      row.append(Object.assign(document.createElement("th"), { textContent: name }));
      row.insertCell().textContent = value;
    }
    const content = document.createElement("div");
    content.append(title, table);
    new maplibre.Popup({ maxWidth: "320px", padding: this.#padding() }).setLngLat(lngLat).setDOMContent(content).addTo(this.#map);
  }
}

/** The smallest box around sessions that have one, in degrees. */
function boxOf(sessions) {
  return joinBoxes(sessions.filter((session) => session.bbox).map((session) =>
    session.georeferenced ? session.bbox : placeLocalBox(session.bbox)));
}

/** A duration for those who like motion. */
function smooth(durationMs) {
  return matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : durationMs;
}

function vehiclePosition(session) {
  return session.georeferenced ? session.vehicle.position.slice(0, 2) : placeLocal(session.vehicle.position);
}

function vehicleLayers(shown) {
  return [{
    id: "vehicles",
    type: "symbol",
    source: "vehicles",
    filter: shown,
    layout: {
      "icon-image": ["get", "icon"],
      "icon-rotate": ["get", "heading"],
      "icon-rotation-alignment": "map",
      "icon-pitch-alignment": "map",
      "icon-allow-overlap": true,
      "icon-ignore-placement": true,
      "icon-size": ["interpolate", ["linear"], ["zoom"], 12, 0.55, 18, 0.9, 22, 1.6],
    },
    paint: { "icon-opacity": ["case", ["get", "live"], 1, 0.45] },
  }];
}

/** A vehicle seen from above: an arrowhead that points up, `colour` with a white rim and a soft shadow. */
function arrow(colour) {
  const size = 64;
  const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
  const pen = canvas.getContext("2d");
  pen.translate(size / 2, size / 2);
  pen.beginPath();
  for (const [x, y] of [[0, -24], [17, 20], [0, 11], [-17, 20]]) pen.lineTo(x, y);
  pen.closePath();
  pen.lineJoin = "round";
  pen.shadowColor = "rgba(0, 0, 0, .55)";
  pen.shadowBlur = 7;
  pen.lineWidth = 7;
  pen.strokeStyle = "#ffffff";
  pen.stroke();
  pen.shadowBlur = 0;
  pen.fillStyle = colour;
  pen.fill();
  return pen.getImageData(0, 0, size, size);
}
