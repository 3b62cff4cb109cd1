// The viewer: the shared map as it grows, the vehicles that find it, and what each of them alone has seen.

import { Feed } from "./feed.js";
import { Panel } from "./panel.js";
import { theme } from "./paint.js";

const panel = new Panel({ choose, overview: () => choose(undefined), follow: toggleFollow });
const feed = new Feed({
  sessions: showSessions,
  lanes: (session, collection) => map?.showLanes(session, collection),
  cell: (cell, collection) => map?.showCell(cell, collection),
  gone: (id) => map?.forget(id),
  connection: (state) => panel.connection(state),
  wants: (session) => session.id === chosen && (map?.sees(session) ?? false),
  wantsCell: (cell) => map?.sees({ ...cell, georeferenced: true }) ?? false,
});

let chosen = new URLSearchParams(location.search).get("session") ?? undefined;
/** Whether what to look at is left to the page: all that lies on the earth, or else the first session. */
let automatic = chosen === undefined;
let following = false;
/** Whether the view was ever set to what there is, and whether the user has moved it since. */
let [placed, moved] = [false, false];
let map;

panel.legend(theme());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => panel.legend(theme()));
mark();
map = await openMap();
await feed.run();

/** The map, or `undefined` with the reason on the page. */
async function openMap() {
  const module = await import("./map.js").catch(() => undefined);
  if (!module) {
    return explain("This server was built where npm could not install MapLibre. Install Node.js with npm and build it "
      + "again (cargo build --release). The lanes are served all the same, as GeoJSON at /sessions/{id}/lanes.geojson.");
  }
  try {
    const opened = new module.LaneMap(document.getElementById("map"), {
      moved: () => (moved = true),
      dragged: () => following && toggleFollow(),
    });
    await opened.ready;
    window.lanemap = opened;
    return opened;
  } catch (error) {
    return explain(`The browser does not draw it: ${error.message}. WebGL 2 is needed.`);
  }
}

function explain(reason) {
  document.getElementById("no-map").hidden = false;
  document.getElementById("no-map-reason").textContent = reason;
}

function showSessions(list, total) {
  panel.sessions(list, total);
  if (automatic) chosen = chosenByPage(list);
  mark();
  map?.showVehicles(list);
  if (!placed) placed = look(0);
  else if (following) map.centre(session());
  else if (!moved && !map.holds(inView())) look(1200);
}

/** Chooses a session and flies to it; `undefined` leaves it to the page. */
function choose(id) {
  [chosen, automatic, following, moved] = [id, id === undefined, false, false];
  if (automatic) chosen = chosenByPage(feed.sessions);
  const address = new URL(location);
  if (id === undefined) address.searchParams.delete("session");
  else address.searchParams.set("session", id);
  history.replaceState(null, "", address);
  mark();
  look(1200);
  feed.hurry();
}

/** None, where some lie on the earth and can be shown together; else the first. */
function chosenByPage(sessions) {
  return sessions.some((each) => each.georeferenced) ? undefined : sessions[0]?.id;
}

function toggleFollow() {
  if (chosen === undefined) return;
  following = !following;
  mark();
  if (following) map?.centre(session());
}

function session() {
  return feed.sessions.find((each) => each.id === chosen);
}

function mark() {
  const local = session() !== undefined && !session().georeferenced;
  panel.choose(chosen, { local, following });
  map?.choose(chosen, local);
}

/** What the view is meant to hold: the chosen session, or all that lie on the earth. */
function inView() {
  const sessions = chosen === undefined ? feed.sessions.filter((each) => each.georeferenced) : [session()];
  return sessions.filter(Boolean);
}

/** Looks at what the view is meant to hold; whether there was something. */
function look(durationMs) {
  return map?.look(inView(), durationMs) ?? false;
}
