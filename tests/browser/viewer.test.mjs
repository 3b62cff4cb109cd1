// What the viewer promises, held against a server that has drives on it (see `run`).

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { join } from "node:path";
import { chromium } from "playwright-core";

const { VIEWER: server, CHROMIUM: executablePath, SCREENSHOTS: screenshots } = process.env;
const DESK = { viewport: { width: 1280, height: 800 } };
const PHONE = { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2, isMobile: true, hasTouch: true };
const FLAGS = [
  "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
  "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
];
const PATIENCE_MS = 60_000;

let browser;
before(async () => (browser = await chromium.launch({ executablePath, args: FLAGS })));
after(() => browser.close());

/** Opens the viewer; `complaints` collects what the console says and whom else the page asks. */
async function open(options, query = "") {
  const context = await browser.newContext(options);
  const page = await context.newPage();
  const complaints = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.stack));
  page.on("requestfailed", (request) => complaints.push(`${request.url()}: ${request.failure().errorText}`));
  page.on("request", (request) => {
    const { protocol, origin } = new URL(request.url());
    if (protocol !== "data:" && origin !== server) complaints.push(`the page asks ${request.url()}`);
  });
  await page.goto(`${server}/viewer${query}`);
  return { page, complaints, close: () => context.close() };
}

const state = (page) => page.evaluate(() => window.lanemap.state);
const total = (page, name) => page.locator(`[data-total="${name}"]`).evaluate((element) => Number(element.textContent));

async function untilDrawn(page) {
  await page.waitForFunction(() => window.lanemap?.state.rendered > 0, undefined, { timeout: PATIENCE_MS });
}

/** The share of the map's pixels that are as light as paint: on a dark theme, only lines and vehicles are. */
async function shareOfPaint(page) {
  await page.evaluate(() => window.lanemap.settled());
  const shot = (await page.locator("#map canvas").screenshot()).toString("base64");
  return page.evaluate(async (png) => {
    const bytes = Uint8Array.from(atob(png), (letter) => letter.charCodeAt(0));
    const image = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const canvas = new OffscreenCanvas(image.width, image.height);
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    const { data } = pen.getImageData(340, 0, image.width - 400, image.height);
    let light = 0;
    for (let pixel = 0; pixel < data.length; pixel += 4) light += data[pixel] > 150 && data[pixel + 1] > 120;
    return light / (data.length / 4);
  }, shot);
}

async function sessions() {
  return (await (await fetch(`${server}/sessions`)).json()).sessions;
}

test("lanes are drawn and grow while vehicles drive, without a complaint or a request to another host", async () => {
  const { page, complaints, close } = await open({ ...DESK, colorScheme: "light" });
  await untilDrawn(page);
  await page.locator('#connection[data-state="connected"]').waitFor();
  const [{ metres }, frames] = [await state(page), await total(page, "frames")];
  assert.ok(metres > 10, `${metres} m of lines`);
  assert.deepEqual(await page.evaluate(() => window.lanemap.sessionsOnScreen()), [], "the shared map is of no drive alone");
  await page.waitForFunction(
    ([metres, frames]) => window.lanemap.state.metres > metres + 50
      && Number(document.querySelector('[data-total="frames"]').textContent) > frames,
    [metres, frames], { timeout: PATIENCE_MS });
  await page.evaluate(() => window.lanemap.settled());
  await page.screenshot({ path: join(screenshots, "desk-light.png") });
  assert.deepEqual(complaints, []);
  await close();
});

test("paint is on the screen in the dark, and a click on a line tells its figures", async () => {
  const { id } = (await sessions()).find((session) => session.georeferenced && session.lanes > 0);
  const { page, complaints, close } = await open({ ...DESK, colorScheme: "dark" }, `?session=${id}`);
  await untilDrawn(page);
  // Near the vehicle; then moved by hand and no longer following, so that the map stands still while the drive goes on.
  await page.keyboard.press("f");
  await page.locator("#map canvas").focus();
  await page.keyboard.press("=");
  await page.keyboard.press("f");
  assert.ok(await shareOfPaint(page) > 0.0005, "hardly a light pixel");
  const place = await page.waitForFunction(() => window.lanemap.somePointOfALine(), undefined, { timeout: PATIENCE_MS });
  const [x, y] = await place.jsonValue();
  await page.mouse.click(x, y);
  await page.locator(".maplibregl-popup").waitFor();
  assert.match(await page.locator(".maplibregl-popup").textContent(), /Lane \d+.*existence.*%.*lateral sigma.*cm/s);
  await page.screenshot({ path: join(screenshots, "desk-dark.png") });
  assert.deepEqual(complaints, []);
  await close();
});

test("a session is chosen, followed and left by keyboard alone, and the address names it", async () => {
  const { page, complaints, close } = await open({ ...DESK, colorScheme: "dark", reducedMotion: "reduce" });
  await untilDrawn(page);
  const { id } = (await sessions()).find((session) => session.georeferenced);
  await page.locator("#overview").focus();
  const focused = () => page.evaluate(() => document.activeElement.querySelector("code")?.textContent);
  for (let presses = 0; (await focused()) !== id; presses += 1) {
    assert.ok(presses < 20, "the session is reached with Tab");
    await page.keyboard.press("Tab");
  }
  await page.keyboard.press("Enter");
  assert.equal(new URL(page.url()).searchParams.get("session"), id);
  assert.equal(await page.locator(`#sessions button[aria-current="true"] code`).textContent(), id);
  await page.waitForFunction((id) => window.lanemap.sessionsOnScreen().join() === id, id, { timeout: PATIENCE_MS });
  await page.keyboard.press("f");
  assert.equal(await page.locator("#follow").getAttribute("aria-pressed"), "true");
  await page.evaluate(() => window.lanemap.settled());
  await page.screenshot({ path: join(screenshots, "desk-follow.png") });
  await page.keyboard.press("Escape");
  assert.equal(new URL(page.url()).searchParams.get("session"), null);
  assert.deepEqual(complaints, []);
  await close();
});

test("a session that is not on the earth is drawn alone, and the page says so", async (t) => {
  const session = (await sessions()).find((each) => !each.georeferenced && each.lanes > 0);
  if (!session) return t.skip("this server has none");
  const { page, complaints, close } = await open({ ...DESK, colorScheme: "light" }, `?session=${session.id}`);
  await untilDrawn(page);
  assert.match(await page.locator("#local-banner").innerText(), /Not on the earth/);
  assert.deepEqual(await page.evaluate(() => window.lanemap.sessionsOnScreen()), [session.id]);
  await page.evaluate(() => window.lanemap.settled());
  await page.screenshot({ path: join(screenshots, "desk-local.png") });
  assert.deepEqual(complaints, []);
  await close();
});

test("on a phone the map keeps the upper half, the panel folds, and nothing sticks out", async () => {
  const { page, complaints, close } = await open({ ...PHONE, colorScheme: "dark" });
  await untilDrawn(page);
  const panel = await page.locator("#panel").boundingBox();
  assert.ok(panel.y >= 0.5 * PHONE.viewport.height, `the panel begins at ${panel.y}`);
  assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), PHONE.viewport.width);
  await page.evaluate(() => window.lanemap.settled());
  await page.screenshot({ path: join(screenshots, "phone-dark.png") });
  await page.locator("#fold").tap();
  assert.ok((await page.locator("#panel").boundingBox()).height < 90);
  assert.deepEqual(complaints, []);
  await close();
});

test("the page says that the connection is lost, and takes up again where the server answers", async () => {
  const { page, close } = await open({ ...DESK, colorScheme: "light" });
  await untilDrawn(page);
  await page.context().setOffline(true);
  await page.locator('#connection[data-state="lost"]').waitFor();
  await page.context().setOffline(false);
  await page.locator('#connection[data-state="connected"]').waitFor();
  await close();
});
