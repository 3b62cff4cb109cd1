// How fluid the map is: frame times while it is moved, zoomed and turned over a town. Not a test: it prints figures.
//
//   VIEWER=http://localhost:8080 CHROMIUM=chromium node tests/browser/fluidity.mjs [SECONDS]
//
// With software GL, as in a headless browser, a frame costs many times what it does on a graphics card: most of it is
// rasterising, in a process of its own. So the page's own part is told, too: what its JavaScript takes of each frame.

import { DESK, launch, open, total, untilDrawn } from "./stage.mjs";

const seconds = Number(process.argv[2] ?? 10);
const WALKS = {
  "whole town": { zoom: 13, stride: 0.010 },
  "quarter": { zoom: 15, stride: 0.004 },
  "street": { zoom: 17, stride: 0.001 },
  "paint": { zoom: 19.5, stride: 0.0002 },
};

const browser = await launch();
for (const [layer, walks] of [["paint", Object.keys(WALKS)], ["sigma", ["quarter", "street"]]]) {
  const { page, close } = await open(browser, { ...DESK, colorScheme: "dark" }, layer === "paint" ? "" : `#layer=${layer}`);
  await untilDrawn(page);
  if (layer === "paint") console.log(`${await total(page, "km")} km of lines, ${DESK.viewport.width} x ${DESK.viewport.height} pixels`);
  for (const name of walks) {
    const { zoom, stride } = WALKS[name];
    const { frames, own } = await page.evaluate(walk, { zoom, stride, seconds });
    console.log(`${layer}, ${name} (zoom ${zoom}): ${frames.length} frames, ${told(frames)}; the page's own part ${told(own)}`);
  }
  await close();
}
await browser.close();

function told(times) {
  const sorted = times.toSorted((one, other) => one - other);
  const at = (share) => sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)].toFixed(1);
  return `median ${at(0.5)} ms, p95 ${at(0.95)} ms, worst ${at(1)} ms`;
}

/**
 * In the page: moves over the largest cells without a stop; resolves to the times between frames, and to those that the page
 * itself takes for one, milliseconds.
 */
async function walk({ zoom, stride, seconds }) {
  const { map: { map }, feed } = window.lanemap;
  const [{ bbox: [west, south, east, north] }] = feed.cells.toSorted((one, other) => other.line_km - one.line_km);
  const [x, y] = [(west + east) / 2, (south + north) / 2];
  map.jumpTo({ center: [x, y], zoom, bearing: 0 });
  await map.once("idle");
  const [times, own] = [[], []];
  const render = map._render;
  map._render = function (...given) {
    const from = performance.now();
    const answer = render.apply(this, given);
    own.push(performance.now() - from);
    return answer;
  };
  const began = performance.now();
  let last = began;
  await new Promise((resolve) => {
    const step = (now) => {
      if (now > last) times.push(now - last);
      last = now;
      const turn = (now - began) / 1000;
      map.jumpTo({
        center: [x + stride * Math.sin(turn), y + stride * 0.7 * Math.sin(0.7 * turn)],
        zoom: zoom + 0.4 * Math.sin(0.5 * turn), bearing: 20 * Math.sin(0.3 * turn),
      });
      if (now - began < seconds * 1000) requestAnimationFrame(step);
      else resolve();
    };
    requestAnimationFrame(step);
  });
  map._render = render;
  return { frames: times, own };
}
