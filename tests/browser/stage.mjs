// The stage of the browser's tests: a browser, pages that complain, and servers of a test's own.

import { spawn } from "node:child_process";
import { createSign, generateKeyPairSync } from "node:crypto";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

export const { VIEWER: demo, CHROMIUM: executablePath, SCREENSHOTS: screenshots, LANEMAP: lanemap, DRIVES: drives } = process.env;
export const DESK = { viewport: { width: 1440, height: 900 } };
export const PHONE = { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2, isMobile: true, hasTouch: true };
export const PATIENCE_MS = 60_000;
const FLAGS = [
  "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
  "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
];

export const launch = () => chromium.launch({ executablePath, args: FLAGS });

/**
 * Opens the viewer of a server; `complaints` collects what the console says, which requests fail and whom else the page
 * asks. `rest` is what of the address comes behind `/viewer`.
 */
export async function open(browser, options, rest = "", server = demo) {
  const context = await browser.newContext(options);
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  const complaints = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.stack));
  page.on("requestfailed", (request) => {
    // A tile is let go of when it leaves the view before it came.
    const reason = request.failure().errorText;
    if (!(reason === "net::ERR_ABORTED" && request.url().includes("/tiles/"))) complaints.push(`${request.url()}: ${reason}`);
  });
  page.on("request", (request) => {
    const { protocol, origin } = new URL(request.url());
    if (!["data:", "blob:"].includes(protocol) && origin !== server) complaints.push(`the page asks ${request.url()}`);
  });
  await page.goto(`${server}/viewer${rest}`);
  return { page, complaints, close: () => context.close() };
}

/** Waits until lines of the shared map are drawn; says how many. */
export async function untilDrawn(page, least = 1) {
  await page.waitForFunction((least) => window.lanemap?.map?.linesOnScreen().length >= least, least, { timeout: PATIENCE_MS });
  return linesOnScreen(page);
}

export const settled = (page) => page.evaluate(() => window.lanemap.map.settled());
export const linesOnScreen = (page) => page.evaluate(() => window.lanemap.map.linesOnScreen().length);
export const total = (page, name) =>
  page.locator(`[data-total="${name}"]`).evaluate((element) => Number.parseFloat(element.textContent));
export const hash = (page, name) => new URLSearchParams(new URL(page.url()).hash.slice(1)).get(name);

/** Latitude and longitude of the middle of the line with most places. */
export async function middleOfSomeLine() {
  let cells = [];
  while (!cells.some(({ lanes }) => lanes > 0)) ({ cells } = await (await fetch(`${demo}/cells`)).json());
  const [cell] = cells.toSorted((one, other) => other.line_km - one.line_km);
  const { features } = await (await fetch(`${demo}/cells/${cell.id}/lanes.geojson`)).json();
  const [longest] = features.toSorted((one, other) => other.geometry.coordinates.length - one.geometry.coordinates.length);
  const { coordinates } = longest.geometry;
  const [longitude, latitude] = coordinates[Math.floor(coordinates.length / 2)];
  return { latitude, longitude };
}

/** What axe finds on the page as it is, of what keeps people out. */
export async function found(page) {
  await page.evaluate(readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8"));
  const { violations } = await page.evaluate(() => window.axe.run(document, { resultTypes: ["violations"] }));
  const grave = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  return grave.flatMap(({ id, nodes }) => nodes.map(({ target, failureSummary }) => `${id} at ${target}: ${failureSummary}`));
}

/** Takes a picture of a page that stands still. */
export async function picture(page, name) {
  await settled(page);
  await page.screenshot({ path: join(screenshots, `${name}.png`) });
}

/** The share of the map's pixels, beside the panel, of which `isWanted(red, green, blue)`. */
export async function shareOfPixels(page, isWanted) {
  await settled(page);
  const shot = (await page.locator("#map canvas").screenshot()).toString("base64");
  return page.evaluate(async ([png, source]) => {
    const isWanted = new Function(`return ${source}`)();
    const bytes = Uint8Array.from(atob(png), (letter) => letter.charCodeAt(0));
    const image = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const canvas = new OffscreenCanvas(image.width, image.height);
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    const { data } = pen.getImageData(360, 0, image.width - 420, image.height - 90);
    let wanted = 0;
    for (let pixel = 0; pixel < data.length; pixel += 4) wanted += isWanted(data[pixel], data[pixel + 1], data[pixel + 2]);
    return wanted / (data.length / 4);
  }, [shot, isWanted.toString()]);
}

/** A folder that goes with the test. */
export function scratch(t) {
  const folder = mkdtempSync(join(tmpdir(), "lanemap-viewer-"));
  t.after(() => rmSync(folder, { recursive: true, force: true, maxRetries: 5 }));
  return folder;
}

/** A server on a folder; `port` 0 takes any. Resolves once it listens, to `{ url, port, kill(signal) }`. */
export async function serve(folder, port = 0, flags = []) {
  const child = spawn(lanemap, ["serve", "--listen", `127.0.0.1:${port}`, "--data-dir", join(folder, "store"), ...flags]);
  const over = new Promise((resolve) => child.once("exit", resolve));
  const lines = createInterface({ input: child.stderr });
  const log = [];
  const address = await new Promise((resolve, reject) => {
    lines.on("line", (line) => {
      log.push(line);
      const found = /serving gRPC and HTTP.*?(127\.0\.0\.1:\d+)/.exec(line.replaceAll(/\u001b\[[0-9;]*m/g, ""));
      if (found) resolve(found[1]);
    });
    over.then(() => reject(new Error(`the server did not start:\n${log.join("\n")}`)));
  });
  const kill = async (signal = "SIGTERM") => {
    child.kill(signal);
    await over;
  };
  return { url: `http://${address}`, port: Number(address.split(":")[1]), kill };
}

/** Streams the recorded drives of a folder to a server. */
export async function replay(url, flags = [], from = drives) {
  const child = spawn(lanemap, ["replay", "--drives", from, "--server", url, ...flags]);
  const said = [];
  child.stderr.on("data", (text) => said.push(text));
  const code = await new Promise((resolve) => child.once("exit", resolve));
  if (code !== 0) throw new Error(`replay failed: ${said.join("")}`);
}

/** Keys of which a server takes tokens, and a token to read with. */
export function readToken(folder) {
  const { privateKey, publicKey } = generateKeyPairSync("ec", { namedCurve: "P-256" });
  const keys = { keys: [{ ...publicKey.export({ format: "jwk" }), kid: "test", alg: "ES256", use: "sig" }] };
  const file = join(folder, "keys.json");
  writeFileSync(file, JSON.stringify(keys));
  const part = (value) => Buffer.from(JSON.stringify(value)).toString("base64url");
  const exp = Math.floor(Date.now() / 1000) + 3600;
  const claims = { iss: "https://issuer.test", aud: "lanemap", exp, fleet: "*", vehicle: "*", scope: "read" };
  const signed = `${part({ alg: "ES256", kid: "test" })}.${part(claims)}`;
  const signature = createSign("SHA256").update(signed).sign({ key: privateKey, dsaEncoding: "ieee-p1363" });
  const flags = ["--token-keys-file", file, "--token-issuer", claims.iss, "--token-audience", claims.aud];
  return { token: `${signed}.${signature.toString("base64url")}`, flags };
}
