// What the viewer promises, held against a server on which simulated vehicles drive (see `run`).

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { writeFileSync } from "node:fs";
import { join } from "node:path";
import {
  DESK, PATIENCE_MS, PHONE, demo, hash, launch, linesOnScreen, middleOfSomeLine, open, picture, scratch, settled, shareOfPixels,
  total, untilDrawn,
} from "./stage.mjs";

let browser;
before(async () => (browser = await launch()));
after(() => browser.close());

const sessions = async () => (await (await fetch(`${demo}/sessions`)).json()).sessions;

test("lines are drawn and grow while vehicles drive, without a complaint or a request to another host", async () => {
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "light" });
  await untilDrawn(page);
  await page.locator('#connection[data-state="connected"]').waitFor();
  const tiles = [];
  page.on("response", (response) => response.url().includes("/tiles/lanes/") && tiles.push(response.url()));
  const km = await total(page, "km");
  assert.ok(km > 0);
  await page.waitForFunction(
    (km) => Number.parseFloat(document.querySelector('[data-total="km"]').textContent) > km + 0.1, km, { timeout: PATIENCE_MS });
  await settled(page);
  assert.ok(tiles.length > 0, "what grew was fetched");
  await picture(page, "desk-light");
  assert.deepEqual(complaints, []);
  await close();
});

test("vehicles move, under the names of their drives alone", async () => {
  const { page, complaints, close } = await open(browser, DESK);
  await untilDrawn(page);
  const places = () => page.evaluate(async () => {
    const { map, feed } = window.lanemap;
    return { drawn: (await map.map.getSource("vehicles").getData()).features, told: feed.vehicles };
  });
  await page.waitForFunction(() => window.lanemap.feed.vehicles.length > 0, undefined, { timeout: PATIENCE_MS });
  const { told } = await places();
  assert.ok(told.every(({ id }) => /^[0-9a-f]{16}$/.test(id)));
  assert.ok(!JSON.stringify(told).includes("vehicle-"), "no vehicle is named");
  const before = (await places()).drawn.find(({ properties }) => properties.drive === told[0].id);
  await page.waitForFunction(async ([id, [x, y]]) => {
    const { features } = await window.lanemap.map.map.getSource("vehicles").getData();
    const now = features.find(({ properties }) => properties.drive === id)?.geometry.coordinates;
    return now && Math.hypot(now[0] - x, now[1] - y) > 1e-5;
  }, [told[0].id, before.geometry.coordinates], { timeout: PATIENCE_MS });
  assert.deepEqual(complaints, []);
  await close();
});

test("layers are chosen by keyboard, each has a scale with units, and a link brings them back", async () => {
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "dark" });
  await untilDrawn(page);
  await page.locator('#layers input[value="paint"]').focus();
  const units = { sigma: /cm/, drives: /drives/, fresh: /days/, existence: /%/ };
  for (const [layer, unit] of Object.entries(units)) {
    await page.keyboard.press("ArrowRight");
    assert.equal(await page.locator("#layers input:checked").inputValue(), layer);
    assert.match(await page.locator("#legend .ramp-labels").innerText(), unit);
    assert.equal(hash(page, "layer"), layer);
    assert.ok(await untilDrawn(page) > 0);
    // The scales have no grey: what is coloured is a measure.
    const coloured = await shareOfPixels(page, (r, g, b) => Math.max(r, g, b) > 130 && Math.max(r, g, b) - Math.min(r, g, b) > 60);
    assert.ok(coloured > 0.0004, `${layer}: ${coloured}`);
    await picture(page, `layer-${layer}`);
  }
  const address = new URL(page.url());
  const again = await open(browser, { ...DESK, colorScheme: "dark" }, address.hash);
  await untilDrawn(again.page);
  assert.equal(await again.page.locator("#layers input:checked").inputValue(), "existence");
  const centre = (page) => page.evaluate(() => window.lanemap.map.map.getCenter().toArray());
  const [[x, y], [u, v]] = [await centre(page), await centre(again.page)];
  assert.ok(Math.hypot(x - u, y - v) < 0.002, "the link shows the same place");
  await page.keyboard.press("1");
  assert.equal(hash(page, "layer"), null);
  assert.deepEqual([...complaints, ...again.complaints], []);
  await again.close();
  await close();
});

test("near the road lines are paint, and a click on one tells its history", async () => {
  // A link to the middle of some line, so near that paint has its true breadth.
  const { latitude, longitude } = await middleOfSomeLine();
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "dark" }, `#at=19/${latitude}/${longitude}`);
  await untilDrawn(page);
  const paint = await shareOfPixels(page, (r, g, b) => r > 150 && g > 120 && b > 20);
  assert.ok(paint > 0.0008, `${paint} of the map is paint`);
  await picture(page, "paint-dark");
  const [x, y] = await page.evaluate(() => window.lanemap.map.somePointOfALine());
  await page.mouse.click(x, y);
  const card = page.locator("#card");
  await card.waitFor();
  assert.match(await card.innerText(), /existence.*sigma across.*drives.*first seen.*last seen.*What it is.*%.*How it came to be/is);
  assert.match(await card.innerText(), /Changed in \d+ version|Changed in 1 version/);
  assert.ok(await card.locator(".bars .bar").count() > 0, "the posterior is there as bars");
  assert.match(hash(page, "lane"), /^14-\d+-\d+\.[0-9a-f-]+\.\d+$/);
  await picture(page, "history-dark");
  await page.keyboard.press("Escape");
  assert.ok(await card.isHidden());
  assert.equal(hash(page, "lane"), null);
  assert.deepEqual(complaints, []);
  await close();
});

test("the slider shows the map as it was, and leads back to now", async () => {
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "light" });
  const now = await untilDrawn(page, 10);
  await page.locator("#bar").waitFor();
  await page.locator("#time").focus();
  await page.keyboard.press("Home");
  await page.waitForFunction(() => /revision=\d/.test(location.hash));
  await page.locator('#connection[data-state="past"]').waitFor();
  await page.waitForFunction((now) => window.lanemap.map.linesOnScreen().length < now / 2, now, { timeout: PATIENCE_MS });
  await page.keyboard.press("PageUp");
  await page.keyboard.press("PageUp");
  await page.keyboard.press("PageUp");
  await picture(page, "past-light");
  const revision = Number(hash(page, "revision"));
  await page.locator("#now").click();
  assert.equal(hash(page, "revision"), null);
  await untilDrawn(page, now / 2);
  const { newest } = await (await fetch(`${demo}/timeline`)).json();
  assert.ok(revision < newest);
  assert.deepEqual(complaints, []);
  await close();
});

test("a drive is chosen by keyboard, replayed and left, and the address names it", async () => {
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "dark", reducedMotion: "reduce" });
  await untilDrawn(page);
  const { id } = (await sessions()).filter((each) => each.georeferenced && each.lanes > 3).at(-1);
  await page.locator("#overview").focus();
  const focused = () => page.evaluate(() => document.activeElement.closest("[data-drive]")?.dataset.drive);
  for (let presses = 0; (await focused()) !== id; presses += 1) {
    assert.ok(presses < 90, "the drive is reached with Tab");
    await page.keyboard.press("Shift+Tab");
  }
  await page.keyboard.press("Enter");
  await page.waitForFunction(() => window.lanemap.map.linesOnScreen(true).length > 0, undefined, { timeout: PATIENCE_MS });
  assert.equal(hash(page, "drive"), id);
  const points = () => page.evaluate(async () => {
    const { features } = await window.lanemap.map.map.getSource("drive").getData();
    return features.reduce((sum, { geometry }) => sum + geometry.coordinates.flat().length, 0);
  });
  const whole = await points();
  await page.locator("#time").focus();
  await page.keyboard.press("Home");
  await page.waitForFunction(async (whole) => {
    const { features } = await window.lanemap.map.map.getSource("drive").getData();
    return features.reduce((sum, { geometry }) => sum + geometry.coordinates.flat().length, 0) < whole / 2;
  }, whole, { timeout: PATIENCE_MS });
  await page.locator("#play").click();
  await page.waitForFunction(() => Number(document.getElementById("time").value) > 20, undefined, { timeout: PATIENCE_MS });
  await page.locator("#play").click();
  await picture(page, "replay-dark");
  await page.keyboard.press("Escape");
  assert.equal(hash(page, "drive"), null);
  assert.deepEqual(complaints, []);
  await close();
});

test("a drive that is not on the earth is drawn alone, and the page says so", async () => {
  const drive = (await sessions()).find((each) => !each.georeferenced && each.lanes > 0);
  assert.ok(drive, "`run` streams one");
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "light" }, `?session=${drive.id}`);
  await page.waitForFunction(() => window.lanemap?.map?.linesOnScreen(true).length > 0, undefined, { timeout: PATIENCE_MS });
  assert.match(await page.locator("#banner").innerText(), /no GNSS/);
  assert.equal(await linesOnScreen(page), 0);
  await picture(page, "own-frame-light");
  assert.deepEqual(complaints, []);
  await close();
});

test("on a phone the map keeps most of the screen, the sheet opens by the tap of a finger, and nothing sticks out", async () => {
  const { page, complaints, close } = await open(browser, { ...PHONE, colorScheme: "dark" });
  await untilDrawn(page);
  const top = async (id) => (await page.locator(id).boundingBox()).y;
  assert.ok(await top("#panel") > 0.8 * PHONE.viewport.height);
  assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), PHONE.viewport.width);
  await picture(page, "phone-dark");
  await page.locator("#grip").tap();
  await page.waitForFunction(() => document.getElementById("panel").getBoundingClientRect().height > 300);
  assert.ok(await top("#panel") > 0.4 * PHONE.viewport.height);
  await page.locator('#layers input[value="drives"]').tap();
  assert.equal(hash(page, "layer"), "drives");
  const small = await page.locator("#panel button:visible, #panel label:visible").evaluateAll((controls) =>
    controls.map((control) => [control.textContent, control.getBoundingClientRect().height]).filter(([, height]) => height < 24));
  assert.deepEqual(small, [], "everything is large enough for a finger");
  await picture(page, "phone-dark-sheet");
  assert.deepEqual(complaints, []);
  await close();
});

test("a file of somebody's own lies over the map, and what is not GeoJSON is told so", async (t) => {
  const { page, complaints, close } = await open(browser, DESK);
  await untilDrawn(page);
  const folder = scratch(t);
  const { lng, lat } = await page.evaluate(() => ({ ...window.lanemap.map.map.getCenter() }));
  const truth = { type: "LineString", coordinates: [[lng, lat], [lng + 0.001, lat + 0.001]] };
  writeFileSync(join(folder, "truth.geojson"), JSON.stringify(truth));
  writeFileSync(join(folder, "list.json"), "[1, 2");
  await page.locator("#truth-file").setInputFiles(join(folder, "truth.geojson"));
  await page.waitForFunction(() => window.lanemap.map.map.queryRenderedFeatures({ layers: ["truth"] }).length > 0);
  await page.locator("#truth-file").setInputFiles(join(folder, "list.json"));
  await page.waitForFunction(() => /list\.json is not GeoJSON/.test(document.getElementById("banner").textContent));
  assert.deepEqual(complaints, []);
  await close();
});

test("all keys are listed under ?, and the page works without motion", async () => {
  const { page, complaints, close } = await open(browser, { ...DESK, reducedMotion: "reduce" });
  await untilDrawn(page);
  await page.locator("#map canvas").focus();
  await page.keyboard.press("?");
  const help = page.locator("#help");
  await help.waitFor();
  const listed = await help.innerText();
  for (const key of ["Space", "L", "F", "0", "M", "P", "T", "C", "Esc"]) assert.ok(listed.includes(key), key);
  await page.keyboard.press("Escape");
  assert.ok(await help.isHidden());
  const zoom = () => page.evaluate(() => window.lanemap.map.map.getZoom());
  const before = await zoom();
  await page.locator("#map canvas").focus();
  await page.keyboard.press("=");
  await page.waitForFunction((before) => window.lanemap.map.map.getZoom() > before, before);
  await page.keyboard.press("t");
  assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), "dark");
  assert.deepEqual(complaints, []);
  await close();
});
