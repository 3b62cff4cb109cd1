// The overlay: a GeoJSON file of somebody's own, laid over the map to be compared. It leaves the browser for nowhere.

import { boxOf } from "./geometry.js";

/** Largest file, bytes. */
const MOST_BYTES = 200e6;

/**
 * Takes files that are chosen or dropped, and the address that the query names (`?truth=`, of this server). `show(features,
 * box, name)` draws them; `refuse(reason)` says why not.
 */
export function takeTruth(server, { show, refuse }) {
  const input = document.getElementById("truth-file");
  document.getElementById("truth-button").addEventListener("click", () => input.click());
  input.addEventListener("change", () => {
    read(input.files[0]);
    input.value = "";
  });
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  document.addEventListener("dragleave", ({ relatedTarget }) => !relatedTarget && document.body.classList.remove("dropping"));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    read(event.dataTransfer.files[0]);
  });
  const address = new URLSearchParams(location.search).get("truth");
  if (address) fetchTruth(address);

  async function read(file) {
    if (!file) return;
    if (file.size > MOST_BYTES) return refuse(`${file.name} has more than ${MOST_BYTES / 1e6} MB.`);
    take(await file.text(), file.name);
  }

  async function fetchTruth(address) {
    const url = new URL(address, document.baseURI);
    if (url.origin !== location.origin) return refuse("The overlay must lie on this server: the page asks no other.");
    try {
      draw(await server.json(url.href), address);
    } catch (error) {
      refuse(`The overlay cannot be read: ${error.message}`);
    }
  }

  function take(text, name) {
    try {
      draw(JSON.parse(text), name);
    } catch (error) {
      refuse(`${name} is not GeoJSON: ${error.message}`);
    }
  }

  function draw(json, name) {
    const features = featuresOf(json).filter(({ geometry }) => geometry?.coordinates);
    const box = boxOf(features.map(({ geometry }) => geometry));
    if (!box) throw new Error("there is no line in it");
    show(features, box, name);
  }
}

function featuresOf(json) {
  if (json.type === "FeatureCollection" && Array.isArray(json.features)) return json.features;
  if (json.type === "Feature") return [json];
  if (json.coordinates) return [{ type: "Feature", properties: {}, geometry: json }];
  throw new Error("it is neither a feature collection, nor a feature, nor a geometry");
}
