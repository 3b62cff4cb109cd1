// What the viewer promises of changes of the road, on a road that changes while vehicles drive on it.

import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import {
  DESK, PATIENCE_MS, PHONE, found, lanemap, launch, open, picture, replay, serve, settled, untilDrawn,
} from "./stage.mjs";

const FLEET = [
  "--roads", "straight", "--shared-route", "--both-directions", "--length-km", "0.5", "--drives", "12", "--changes", "1", "--seed", "3",
];
const KINDS = "kind=appeared,vanished,moved,repainted";

let [browser, server, folder] = [];
before(async () => {
  folder = mkdtempSync(join(tmpdir(), "lanemap-changes-"));
  const made = spawnSync(lanemap, ["simulate", "--out", join(folder, "drives"), ...FLEET], { encoding: "utf8" });
  assert.equal(made.status, 0, made.stderr);
  server = await serve(folder);
  await replay(server.url, ["--origin", "45.06,7.67"], join(folder, "drives"));
  for (let cells = {}; !(cells.settled && cells.total > 0);) cells = await (await fetch(`${server.url}/cells`)).json();
  assert.ok((await events()).some(({ properties }) => !properties.withdrawn), "a change of the road is told");
  browser = await launch();
});
after(async () => {
  await browser?.close();
  await server?.kill();
  rmSync(folder, { recursive: true, force: true, maxRetries: 5 });
});

const events = async () => (await (await fetch(`${server.url}/events?${KINDS}`)).json()).features;
const show = (options, look = {}) => open(browser, { ...options, ...look }, "#layer=change", server.url);
const listed = (page) => page.locator("#happened li");

test("what happened to the road is drawn and listed with how sure it is and when, and a click tells of it", async () => {
  const { page, complaints, close } = await show(DESK, { colorScheme: "light" });
  await listed(page).first().waitFor({ timeout: PATIENCE_MS });
  const told = (await events()).filter(({ properties }) => !properties.withdrawn);
  assert.equal(await listed(page).count(), Math.min(told.length, 8));
  assert.match(await listed(page).first().innerText(), /(appeared|vanished|moved|now)[\s\S]*%[\s\S]*2025/);
  assert.match(await page.locator("#layer-says").innerText(), new RegExp(`^${told.length} changes? of the road in view`));
  await settled(page);
  await picture(page, "changes-far");

  await listed(page).first().locator("button").click();
  const card = page.locator("#card");
  await card.locator("h2").waitFor();
  assert.match(await card.locator("h2").innerText(), /appeared|vanished|moved|now/);
  assert.match(await card.innerText(), /probability[\s\S]*noticed[\s\S]*drive of/);
  await settled(page);
  assert.deepEqual(await found(page), [], "the card of a change");
  await picture(page, "changes-card-light");

  // The stretch itself is clicked, beside its mark.
  await page.keyboard.press("Escape");
  await card.waitFor({ state: "hidden" });
  const [x, y, title] = await page.evaluate(async () => {
    const { features } = await window.lanemap.map.map.getSource("events").getData();
    const free = window.lanemap.map.padding();
    const inside = ({ x, y }) => x > free.left && x < innerWidth - 70 && y > free.top && y < innerHeight - free.bottom;
    for (const { geometry, properties } of features.filter(({ geometry }) => geometry.type === "LineString")) {
      const at = geometry.coordinates.map((place) => window.lanemap.map.map.project(place)).find(inside);
      if (at) return [at.x, at.y, properties.kind];
    }
    return [];
  });
  await page.mouse.click(x, y);
  await card.locator("h2").waitFor();
  assert.match(await card.locator("h2").innerText(), new RegExp(title));
  await card.getByRole("button", { name: "The line's history" }).click();
  await card.getByText("How it came to be").waitFor();
  await picture(page, "changes-history");
  assert.deepEqual(complaints, []);
  await close();
});

test("changes are told in the dark and on a phone, and other layers say nothing of them", async () => {
  const dark = await show(DESK, { colorScheme: "dark" });
  await listed(dark.page).first().waitFor({ timeout: PATIENCE_MS });
  await listed(dark.page).first().locator("button").click();
  await settled(dark.page);
  assert.deepEqual(await found(dark.page), [], "the card of a change, in the dark");
  await picture(dark.page, "changes-card-dark");
  await dark.page.keyboard.press("1");
  await dark.page.locator("#happened").waitFor({ state: "hidden" });
  assert.deepEqual(dark.complaints, []);
  await dark.close();

  const phone = await show(PHONE);
  await untilDrawn(phone.page);
  await listed(phone.page).first().waitFor({ state: "attached", timeout: PATIENCE_MS });
  await picture(phone.page, "changes-phone");
  assert.deepEqual(phone.complaints, []);
  await phone.close();
});
