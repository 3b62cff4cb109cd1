// Tiles as MapLibre reads them: node check.mjs URL FOLDER
//
// Every tile with lines decodes with @mapbox/vector-tile, its layers are those that the TileJSON describes, and the style is
// valid. The tiles are left in FOLDER, with what was read of them in FOLDER/lines.json.
import assert from "node:assert/strict";
import { mkdir, writeFile } from "node:fs/promises";

import { validateStyleMin } from "@maplibre/maplibre-gl-style-spec";
import { VectorTile } from "@mapbox/vector-tile";
import { PbfReader } from "pbf";

const [url, folder] = process.argv.slice(2);
const json = async (path) => (await fetch(url + path)).json();

// The map settles once all that drives said is in it.
let cells = await json("/cells");
while (!cells.settled || cells.cells.every((cell) => cell.lanes === 0)) {
  await new Promise((resolve) => setTimeout(resolve, 200));
  cells = await json("/cells");
}

const style = await json("/styles/lanes.json");
assert.deepEqual(validateStyleMin(style), [], "the style is valid");
const tileJson = await json("/tiles/lanes");
const described = new Map(tileJson.vector_layers.map((layer) => [layer.id, layer]));
for (const layer of style.layers) {
  assert.ok(layer.type === "background" || described.has(layer["source-layer"]), layer.id);
}

const places = [];
for (const cell of cells.cells) {
  for (const feature of (await json(`/cells/${cell.id}/lanes.geojson`)).features) {
    places.push(...feature.geometry.coordinates.flat(feature.geometry.type === "LineString" ? 0 : 1));
  }
}
const tileAt = ([longitude, latitude], zoom) => {
  const y = 0.5 - Math.asinh(Math.tan((latitude * Math.PI) / 180)) / (2 * Math.PI);
  return [longitude / 360 + 0.5, y].map((share) => Math.floor(share * 2 ** zoom));
};

const lines = {};
for (let zoom = tileJson.minzoom; zoom <= tileJson.maxzoom; zoom += 1) {
  const names = new Set(places.map((place) => tileAt(place, zoom).join("/")));
  for (const name of [...names].sort().slice(0, 60)) {
    const [x, y] = name.split("/");
    const address = tileJson.tiles[0].replace("{z}", zoom).replace("{x}", x).replace("{y}", y);
    const answer = await fetch(address);
    assert.equal(answer.headers.get("content-type"), "application/vnd.mapbox-vector-tile", address);
    const bytes = new Uint8Array(await answer.arrayBuffer());
    const tile = new VectorTile(new PbfReader(bytes));
    const wanted = [...described.values()].filter((layer) => layer.minzoom <= zoom).map((layer) => layer.id);
    // Not in every tile a line is dashed.
    const some = wanted.filter((id) => id !== "dashes" || tile.layers.dashes);
    assert.deepEqual(Object.keys(tile.layers).sort(), some.sort(), address);
    lines[`${zoom}/${name}`] = {};
    for (const [id, layer] of Object.entries(tile.layers)) {
      assert.ok(layer.length > 0 && layer.extent === 4096 && layer.version === 2, `${address} ${id}`);
      const features = Array.from({ length: layer.length }, (_, index) => layer.feature(index));
      assert.equal(new Set(features.map((feature) => feature.id)).size, layer.length, "ids are unique");
      for (const feature of features) {
        assert.equal(feature.type, 2);
        const fields = described.get(id).fields;
        for (const [key, value] of Object.entries(feature.properties)) {
          assert.equal(typeof value, fields[key].toLowerCase(), `${id}.${key}`);
        }
      }
      lines[`${zoom}/${name}`][id] = features.map((feature) => feature.loadGeometry().map((part) => part.map((at) => [at.x, at.y])));
    }
    await mkdir(`${folder}/${zoom}/${x}`, { recursive: true });
    await writeFile(`${folder}/${zoom}/${name}.mvt`, bytes);
  }
}
await writeFile(`${folder}/lines.json`, JSON.stringify(lines));
assert.ok(Object.values(lines).some(({ dashes }) => dashes), "some line is dashed");
console.log(`${Object.keys(lines).length} tiles decode with @mapbox/vector-tile; the style is valid`);
