// The viewer: the shared map as it grows, the vehicles that find it, its past, and what each drive alone has seen.

import { readAddress, saysWhere, writeAddress } from "./address.js";
import { Around } from "./around.js";
import { Bar, clock, elapsed } from "./bar.js";
import { Card, metres } from "./card.js";
import { Feed } from "./feed.js";
import { boxOf, joinBoxes } from "./geometry.js";
import { PATH as HAPPENED, believed, drawn } from "./happened.js";
import { bindKeys, toggleHelp } from "./keys.js";
import { LAYERS, Panel } from "./panel.js";
import { Past } from "./past.js";
import { Replay } from "./replay.js";
import { Ruler } from "./ruler.js";
import { Server } from "./server.js";
import { togglePanel } from "./sheet.js";
import { onTheme, switchTheme } from "./theme.js";
import { takeTruth } from "./truth.js";
import { Vehicles } from "./vehicles.js";

const element = (id) => document.getElementById(id);

const said = readAddress();
let layer = LAYERS.some(({ id }) => id === said.layer) ? said.layer : "paint";
/** How much of the map differs from what it was. */
let differing = { count: 0, more: false };
/** The revision that is shown; none: the newest. */
let revision = /^\d+$/.test(said.revision ?? "") ? Number(said.revision) : undefined;
let wantedDrive = said.drive;
let replay;
let following = false;
/** Whether the view was ever set to what there is, and whether the user has moved it since. */
let [placed, moved] = [saysWhere(), saysWhere()];
/** Whether the server was lost, or locked, since it last answered. */
let wasAway = false;
let map;

const server = new Server({ state: showConnection });
const past = new Past(server, { revision: goTo });
const bar = new Bar();
const panel = new Panel({ layer: chooseLayer, drive: chooseDrive, overview });
const card = new Card(server, { close: closeCard, look: lookAtLine, line: (id) => chooseLine(id, { look: true }) });
/** What happened to the road within the view, by its ids. */
let events = new Map();
const vehicles = new Vehicles((features) => map?.put("vehicles", features));
const ruler = new Ruler((features) => map?.put("ruler", features), sayLength);
const happened = new Around(server, () => HAPPENED, (told) => {
  events = new Map(believed(told).map((event) => [event.id, event]));
  map?.put("events", drawn([...events.values()]));
  panel.happened(layer === "change" ? [...events.values()] : undefined, (event) => chooseEvent(event, { look: true }));
  if (layer === "change") sayChanges();
});
/** What differs between the time of the slider and now; lines are clicked as the map's own are. */
const differences = new Around(server, (since) => `differences?since=${since}`, ({ features, more }) => {
  map?.put("changes", features.map((feature) => ({ ...feature, properties: { ...feature.properties, part: 0 } })));
  differing = { count: features.length, more };
  if (layer === "change") sayChanges();
});
const feed = new Feed(server, past, {
  vehicles: (totals) => (panel.totals(totals), showVehicles()),
  cells: showCells,
  drives: showDrives,
  past: showPast,
  round: () => replay?.drive.state === "live" && refreshDrive(),
});

panel.layer(layer);
onTheme(() => panel.recolour());
bindControls();
map = await openMap();
if (map) {
  map.show({ layer });
  showRevision();
  map.map.on("moveend", lookAtChanges);
  takeTruth(server, { show: showTruth, refuse: (reason) => note(reason) });
  if (said.lane) chooseLine(said.lane, { look: !placed }).catch(() => writeAddress({ lane: undefined }));
  setInterval(() => map.show({ nowS: Math.round(Date.now() / 1000) }), 30_000);
}
window.lanemap = { map, feed, bar, server };
feed.follow();
await server.watch(() => feed.look());

/** The map, or `undefined` with the reason on the page. */
async function openMap() {
  const module = await import("./map.js").catch(() => undefined);
  if (!module) {
    return explain("This server was built where npm could not install MapLibre. Install Node.js with npm and build it "
      + "again (cargo build --release). The lanes are served all the same, as GeoJSON at /collections/lanes/items.");
  }
  try {
    const opened = new module.LaneMap(element("map"), server, {
      moved: () => (moved = true),
      dragged: () => following && toggleFollow(),
      clicked,
      pointed,
      failed,
    });
    await opened.ready;
    return opened;
  } catch (error) {
    return explain(`The browser does not draw it: ${error.message}. WebGL 2 is needed.`);
  }
}

/** A tile could not be had. That a server does not answer is told by the feed. */
function failed(error) {
  if (error?.status === 401) server.enter("locked", "");
  else if (error?.status !== undefined || !/fetch/i.test(error?.message)) console.error("the map:", error);
}

function explain(reason) {
  element("no-map").hidden = false;
  element("no-map-reason").textContent = reason;
}

/* The connection */


function showConnection(state, reason) {
  panel.connection(state === "connected" && revision !== undefined ? "past" : state);
  if (state === "connected") {
    hideBanner("lost");
    if (element("lock").open) element("lock").close();
    // What came while the server was away is not told: all is asked for again.
    if (wasAway) map?.reload();
    if (wasAway) feed.forget();
    wasAway = false;
  } else if (state === "lost") {
    wasAway = true;
    banner("lost", `The server does not answer (${reason}). What is drawn is what it last said; the page tries again by itself.`);
  } else if (state === "locked") {
    wasAway = true;
    element("lock-reason").textContent = reason || "Its maps are for those who may read them.";
    if (!element("lock").open) element("lock").showModal();
  }
}

function banner(kind, text, action) {
  element("banner").replaceChildren(text);
  if (action) element("banner").append(Object.assign(document.createElement("button"), { type: "button", ...action }));
  element("banner").dataset.kind = kind;
  element("banner").hidden = false;
}

function hideBanner(kind) {
  if (element("banner").dataset.kind === kind) element("banner").hidden = true;
}

function note(text) {
  banner("note", text, { textContent: "Close", onclick: () => hideBanner("note") });
}

/* The shared map */

function showCells(changed) {
  const lined = feed.cells.filter(({ lanes }) => lanes > 0);
  const km = lined.reduce((sum, { line_km }) => sum + line_km, 0);
  panel.totals({ km, sigma_m: typicalSigma(lined) });
  element("welcome").hidden = lined.length > 0 || feed.total > 0;
  if (!map) return;
  map.put("cells", lined.map(cellSquare));
  if (revision === undefined) {
    // Lines are joined over a cell's border: tiles beside it show them, too.
    const boxes = changed.map(({ bbox: [west, south, east, north] }) => [west - 1e-4, south - 1e-4, east + 1e-4, north + 1e-4]);
    map.reloadWithin(boxes.filter((box) => map.sees(box)));
    if (card.id && changed.some(({ id }) => card.id.startsWith(`${id}.`))) card.show(card.id).catch(() => {});
  }
  if (changed.length > 0) lookAtChanges();
  keepInView();
}

/** The median over cells of their lines' typical sigma, each with the weight of its length. */
function typicalSigma(cells) {
  const known = cells.filter((cell) => cell.median_lateral_sigma_m !== undefined)
    .sort((one, other) => one.median_lateral_sigma_m - other.median_lateral_sigma_m);
  const half = known.reduce((sum, { line_km }) => sum + line_km, 0) / 2;
  let passed = 0;
  return known.find(({ line_km }) => (passed += line_km) >= half)?.median_lateral_sigma_m ?? NaN;
}

/** A cell as it is seen from afar: the more lines it has, the stronger. */
function cellSquare({ bbox: [west, south, east, north], line_km }) {
  const ring = [[west, south], [east, south], [east, north], [west, north], [west, south]];
  return { type: "Feature", properties: { line_km }, geometry: { type: "Polygon", coordinates: [ring] } };
}

function chooseLayer(id) {
  layer = id;
  panel.layer(id);
  map?.show({ layer: id });
  showRevision();
  writeAddress({ layer: id === "paint" ? undefined : id });
}

/** Draws what happened to the road and, where the slider is in the past, what of the map was not so then. */
function lookAtChanges() {
  if (!map || layer !== "change") return;
  const view = map.map.getBounds().toArray().flat();
  happened.look(view);
  if (revision === undefined) differences.stop();
  else differences.look(view, revision);
}

function sayChanges() {
  const count = (number, name) => `${number === 0 ? "No" : number} ${name}${number === 1 ? "" : "s"}`;
  const here = `${count(events.size, "change")} of the road in view. `;
  const since = revision === undefined ? undefined : past.timeOf(revision);
  panel.says(here + (since === undefined ? "Go back in time to see how the map differs from what it was."
    : `${differing.more ? "More than " : ""}${count(differing.count, "stretch").replace("stretchs", "stretches")} of the map differ from what it was at ${clock(since)}.`));
}

/* Time */

function showPast() {
  if (replay) return;
  bar.show(past.timeline());
  if (revision === undefined) lookAtChanges();
  const at = revision === undefined ? undefined : past.timeOf(revision);
  if (at !== undefined && bar.isLive) bar.goTo(at);
  else if (revision !== undefined && at === undefined) {
    note(`Revision ${revision} of the map is no longer kept; this is the newest.`);
    goTo(undefined);
  }
}

/** Shows the map at a revision; none: the newest. */
function goTo(wanted) {
  if (wanted === revision) return;
  revision = wanted;
  showRevision();
  writeAddress({ revision });
  panel.connection(revision === undefined ? server.state : "past");
  showVehicles();
}

/** The layer of changes shows what is now, and what of it was not then; all others the map as it was. */
function showRevision() {
  map?.goTo(layer === "change" ? undefined : revision);
  if (layer === "change") return lookAtChanges();
  differences.stop();
  return happened.stop();
}

/* Vehicles and drives */

function showVehicles() {
  if (replay) return;
  const seen = revision === undefined ? feed.vehicles : [];
  vehicles.tell(seen.map(({ id, geometry, properties }) => ({
    id, place: geometry.coordinates.slice(0, 2), heading: properties.heading_deg, chosen: false,
  })));
}

function showDrives() {
  panel.drives(feed.drives, feed.total);
  element("welcome").hidden = feed.total > 0 || feed.cells.some(({ lanes }) => lanes > 0);
  if (wantedDrive !== undefined) {
    const id = wantedDrive;
    wantedDrive = undefined;
    chooseDrive(id);
  } else if (!placed && feed.cells.length === 0) {
    // Nothing on the earth yet: a drive of its own frame can be shown alone.
    const [only] = feed.drives.filter(({ lanes, georeferenced }) => lanes > 0 && !georeferenced);
    if (only && !replay && !feed.drives.some(({ georeferenced }) => georeferenced)) chooseDrive(only.id);
  }
  keepInView();
}

/** Shows what one drive alone saw, to be replayed; none: the shared map. */
async function chooseDrive(id) {
  const drive = feed.drives.find((each) => each.id === id) ?? (id && await foundDrive(id));
  panel.choose(drive?.id);
  writeAddress({ drive: drive?.id });
  following = false;
  if (!drive) return leaveDrive();
  closeCard();
  const opened = new Replay(drive, drawDrive);
  try {
    if (!await opened.fetch(server)) return note("This drive has been nowhere yet.");
  } catch (error) {
    return note(`The drive cannot be shown: ${error.message}`);
  }
  replay?.stop();
  replay = opened;
  map?.show({ drive: { local: !drive.georeferenced } });
  bar.show(undefined);
  showReplay();
  replay.show(undefined, { whole: true });
  if (!drive.georeferenced) note("This drive has no GNSS: its own frame, in metres, is drawn at 0, 0.");
  if (!placed || !map?.holds(replay.box)) map?.look(replay.box, 1200);
  placed = moved = true;
  return undefined;
}

/** A drive that is not among the newest. */
async function foundDrive(id) {
  const own = await server.json(`sessions/${encodeURIComponent(id)}/lanes.geojson?crs=local`).catch(() => undefined);
  if (!own) return note(`There is no drive ${id} here.`);
  const placed = await server.json(`sessions/${encodeURIComponent(id)}/lanes.geojson`).catch(() => undefined);
  return { id, number: "", version: own.version, georeferenced: placed !== undefined, state: "closed" };
}

function leaveDrive() {
  if (!replay) return;
  replay.stop();
  replay = undefined;
  hideBanner("note");
  for (const source of ["drive", "trace"]) map?.put(source, []);
  map?.show({ drive: undefined });
  bar.show(undefined);
  showPast();
  showVehicles();
}

function showReplay() {
  bar.show({
    label: `Drive ${replay.drive.id}`,
    from: replay.from,
    to: replay.to,
    speed: Math.max((replay.to - replay.from) / 60_000, 1),
    end: replay.drive.state === "live" ? "Live" : "End",
    say: (ms) => `${elapsed(ms - replay.from)} / ${elapsed(replay.to - replay.from)}`,
    at: (ms) => replay.show(ms),
    live: () => replay.show(undefined, { whole: true }),
  });
}

/** Draws what was told of a drive. */
function drawDrive({ lanes, trace, vehicle }) {
  if (lanes) map?.put("drive", lanes);
  if (trace) map?.put("trace", trace);
  vehicles.tell([{ id: replay?.drive.id ?? "", ...vehicle, chosen: true }], { takesMs: replay?.drive.state === "live" && bar.isLive ? 500 : 0 });
  if (following) map?.centre(vehicle.place, 300);
}

/** A live drive has gone on. */
async function refreshDrive() {
  const shown = replay;
  const now = feed.drives.find(({ id }) => id === shown.drive.id);
  if (!now || now.version === shown.drive.version) return;
  shown.drive = now;
  await shown.fetch(server).catch(() => {});
  if (replay !== shown) return;
  const atEnd = bar.isLive;
  showReplay();
  if (atEnd) shown.show(undefined, { whole: true });
}

function toggleFollow() {
  const target = replay?.drive.id ?? nearestVehicle();
  following = !following && target !== undefined;
  if (!following) return;
  if (!replay) chooseDrive(target).then(() => (following = true));
  else bar.isLive ? replay.show(undefined, { whole: true }) : replay.show(bar.ms, { whole: true });
}

/** The live vehicle that is nearest to the middle of the map. */
function nearestVehicle() {
  const { lng, lat } = map.map.getCenter();
  const far = ({ geometry: { coordinates: [x, y] } }) => Math.hypot((x - lng) * Math.cos((lat * Math.PI) / 180), y - lat);
  return feed.vehicles.toSorted((one, other) => far(one) - far(other))[0]?.id;
}

/* Lines */

function clicked(feature, place) {
  if (ruler.active) return ruler.add(place);
  const event = events.get(feature?.properties.event);
  if (event) return chooseEvent(event);
  if (!feature?.properties.lane) return closeCard();
  const { cell, lane, part } = feature.properties;
  return chooseLine(`${cell}.${lane}.${part}`).catch((error) => note(`The line cannot be read: ${error.message}`));
}

async function chooseLine(id, { look = false } = {}) {
  map?.show({ lane: id.split(".")[1], event: undefined });
  writeAddress({ lane: id });
  const feature = await card.show(id);
  if (card.id === undefined) closeCard();
  else if (feature && look) lookAtLine(feature);
}

/** Tells what happened to a stretch of road. */
function chooseEvent(event, { look = false } = {}) {
  map?.show({ lane: undefined, event: event.id });
  writeAddress({ lane: undefined });
  card.tell(event);
  if (look) lookAtLine(event);
}

function closeCard() {
  card.close();
  map?.show({ lane: undefined, event: undefined });
  writeAddress({ lane: undefined });
}

function lookAtLine(feature) {
  [placed, moved] = [true, true];
  map?.look(boxOf([feature.geometry]), 900, 20);
}

/* The view */

/** The box around the whole map: lines of cells, and drives. */
function wholeBox() {
  const cells = feed.cells.filter(({ lanes }) => lanes > 0).map(({ bbox }) => bbox);
  const drives = feed.drives.filter(({ bbox, georeferenced }) => bbox && georeferenced).map(({ bbox }) => bbox);
  // Drives tell it more closely than cells, where they are all here.
  return joinBoxes(drives.length > 0 && feed.total <= feed.drives.length ? drives : [...cells, ...drives]);
}

/** The map grows: it is kept in view until somebody moves it. */
function keepInView() {
  if (!map || replay || revision !== undefined) return;
  const box = wholeBox();
  if (!placed) placed = map.look(box, 0);
  else if (!moved && !map.holds(box)) map.look(box, 1200);
}

function overview() {
  if (replay) chooseDrive(undefined);
  moved = false;
  map?.look(wholeBox(), 1000);
}

function pointed(place) {
  ruler.hover(place);
  element("readout").textContent = `${place[1].toFixed(6)}, ${place[0].toFixed(6)}`;
}

function sayLength(length, count) {
  if (!ruler.active) return hideBanner("ruler");
  return banner("ruler", count < 2 ? "Click two places or more." : metres(length), { textContent: "Done", onclick: toggleRuler });
}

function toggleRuler() {
  ruler.toggle();
  element("measure").setAttribute("aria-pressed", String(ruler.active));
  if (map) map.busy = ruler.active;
}

function showTruth(features, box, name) {
  map.put("truth", features);
  note(`${name}: ${features.length} features lie over the map.`);
  if (!map.sees(box)) map.look(box, 1000);
}

async function share() {
  try {
    await navigator.clipboard.writeText(location.href);
    note("The link to what is shown is in the clipboard.");
  } catch {
    note("The address of this page shows what you see: copy it from the browser.");
  }
}

/** Closes what lies on top. */
function back() {
  if (ruler.active) toggleRuler();
  else if (card.isOpen) closeCard();
  else if (replay) chooseDrive(undefined);
  else if (revision !== undefined) bar.live();
  else overview();
}

function bindControls() {
  element("theme").addEventListener("click", switchTheme);
  element("share").addEventListener("click", share);
  element("measure").addEventListener("click", toggleRuler);
  element("lock").querySelector("form").addEventListener("submit", (event) => {
    event.preventDefault();
    server.unlock(element("token").value);
    element("token").value = "";
    element("lock").close();
  });
  // Closed without a token it would leave a page that shows nothing and says nothing.
  element("lock").addEventListener("cancel", (event) => event.preventDefault());
  document.querySelector("[data-origin]").textContent = server.address(".").replace(/\/$/, "");
  bindKeys([
    { keys: ["1", "…", String(LAYERS.length)], says: "Colour lines by paint, uncertainty, support, …" },
    ...LAYERS.map(({ id }, index) => ({ keys: [String(index + 1)], act: () => chooseLayer(id) })),
    { keys: ["Space"], says: "Play or pause time", act: () => bar.toggle() },
    { keys: ["L"], says: "Back to what is now", act: () => bar.live() },
    { keys: ["F"], says: "Follow the drive, or the nearest vehicle", act: toggleFollow },
    { keys: ["0"], says: "The whole map", act: overview },
    { keys: ["M"], says: "Measure", act: toggleRuler },
    { keys: ["P"], says: "Show or hide the panel", act: togglePanel },
    { keys: ["T"], says: "Light or dark", act: switchTheme },
    { keys: ["C"], says: "Copy a link to what is shown", act: share },
    { keys: ["←", "→", "↑", "↓", "+", "-"], says: "Move and zoom, when the map has the focus; with Shift: turn and tilt" },
    { keys: ["Esc"], says: "Close what is on top", act: back },
    { keys: ["?"], says: "This page", act: toggleHelp },
  ]);
}
