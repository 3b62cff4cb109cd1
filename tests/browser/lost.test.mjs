// What the page does when the server is not there, asks who it is, or has nothing.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { DESK, PHONE, launch, open, picture, readToken, replay, scratch, serve, untilDrawn } from "./stage.mjs";

let browser;
before(async () => (browser = await launch()));
after(() => browser.close());

test("a newcomer is told what to do while there is no map, and sees the first drive without a reload", async (t) => {
  const server = await serve(scratch(t));
  t.after(() => server.kill("SIGKILL"));
  const { page, complaints, close } = await open(browser, { ...DESK, colorScheme: "light" }, "", server.url);
  await page.locator("#welcome").waitFor();
  assert.match(await page.locator("#welcome").innerText(), /lanemap demo/);
  await page.screenshot({ path: `${process.env.SCREENSHOTS}/empty-light.png` });
  await replay(server.url, ["--origin", "45.06,7.67"]);
  await untilDrawn(page);
  assert.ok(await page.locator("#welcome").isHidden());
  assert.deepEqual(complaints, []);
  await close();
});

test("a server that is killed is missed, and the page goes on where it comes back with more", async (t) => {
  const folder = scratch(t);
  let server = await serve(folder);
  t.after(() => server.kill("SIGKILL"));
  await replay(server.url, ["--origin", "45.06,7.67"]);
  const { page, close } = await open(browser, { ...PHONE, colorScheme: "light" }, "", server.url);
  const drawn = await untilDrawn(page);
  const { url, port } = server;
  await server.kill("SIGKILL");
  await page.locator('#connection[data-state="lost"]').waitFor();
  await page.locator("#banner").waitFor();
  await picture(page, "lost-phone");
  assert.equal(await page.evaluate(() => window.lanemap.map.linesOnScreen().length), drawn, "what is drawn stays");
  server = await serve(folder, port);
  assert.equal(server.url, url);
  await page.locator('#connection[data-state="connected"]').waitFor();
  assert.ok(await page.locator("#banner").isHidden());
  await untilDrawn(page, drawn);
  await close();
});

test("where a server asks for a token the page asks for it, once for a tab, and sends it with tiles, too", async (t) => {
  const folder = scratch(t);
  const { token, flags } = readToken(folder);
  let server = await serve(folder);
  t.after(() => server.kill("SIGKILL"));
  await replay(server.url, ["--origin", "45.06,7.67"]);
  await server.kill();
  server = await serve(folder, 0, flags);
  const { page, close } = await open(browser, { ...DESK, colorScheme: "light" }, "", server.url);
  await page.locator("#lock").waitFor();
  await page.screenshot({ path: `${process.env.SCREENSHOTS}/locked-light.png` });
  await page.locator("#token").fill("no token");
  await page.keyboard.press("Enter");
  await page.locator('#connection[data-state="locked"]').waitFor();
  await page.locator("#lock").waitFor();
  await page.locator("#token").fill(token);
  await page.keyboard.press("Enter");
  await untilDrawn(page);
  await page.reload();
  await untilDrawn(page);
  assert.ok(await page.locator("#lock").isHidden());
  assert.ok(!page.url().includes(token.slice(0, 20)));
  await close();
});
