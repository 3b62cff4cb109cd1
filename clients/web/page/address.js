// The address: what the page shows stands behind the `#`, so that a link shows it to somebody else.
//
// MapLibre keeps `at` (zoom, latitude, longitude, bearing, pitch) there itself; the rest is the page's.

const NAMES = ["layer", "lane", "drive", "revision"];

/** What the address says, by name; what it does not say is left out. */
export function readAddress() {
  const said = new URLSearchParams(location.hash.slice(1));
  const state = Object.fromEntries(NAMES.filter((name) => said.get(name)).map((name) => [name, said.get(name)]));
  // Links of the list of sessions name a drive in the query.
  const session = new URLSearchParams(location.search).get("session");
  return { ...(session ? { drive: session } : {}), ...state };
}

/** Whether the address says where to look. */
export function saysWhere() {
  return /(^#|&)at=/.test(location.hash);
}

/** Writes into the address what is given; `undefined` takes a name out. */
export function writeAddress(state) {
  const address = new URL(location);
  const parts = address.hash.slice(1).split("&").filter((part) => part && !(part.split("=")[0] in state));
  for (const name of NAMES) {
    if (state[name] !== undefined) parts.push(`${name}=${encodeURIComponent(state[name])}`);
  }
  address.hash = parts.join("&");
  if ("drive" in state) address.searchParams.delete("session");
  history.replaceState(null, "", parts.length > 0 ? address : address.href.replace(/#$/, ""));
}
