// How the page looks, and whether everybody can use it: axe finds nothing serious, in any of its states.

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { DESK, PHONE, found, launch, middleOfSomeLine, open, picture, untilDrawn } from "./stage.mjs";

let browser;
before(async () => (browser = await launch()));
after(() => browser.close());

for (const [device, options] of [["desk", DESK], ["phone", PHONE]]) {
  for (const colorScheme of ["light", "dark"]) {
    test(`axe finds nothing serious on a ${device} in the ${colorScheme}`, async () => {
      // Near enough that a line crosses what a phone shows of the map.
      const { latitude, longitude } = await middleOfSomeLine();
      const place = `#at=16/${latitude}/${longitude}`;
      const { page, close } = await open(browser, { ...options, colorScheme, reducedMotion: "reduce" }, place);
      await untilDrawn(page);
      const where = `${device}-${colorScheme}`;
      assert.deepEqual(await found(page), [], "the map");
      if (device === "phone") await page.locator("#grip").click();
      for (const layer of ["sigma", "change", "paint"]) {
        await page.locator(`#layers input[value="${layer}"]`).check({ force: true });
        assert.deepEqual(await found(page), [], `layer ${layer}`);
      }
      // Two taps, not a double one: the grip goes up with the sheet, and the second would miss it.
      for (const _ of device === "phone" ? ["full", "peek"] : []) await page.locator("#grip").click();
      await page.evaluate(async () => {
        const { map } = window.lanemap;
        const [x, y] = await map.somePointOfALine();
        map.map.fire("click", { point: { x, y }, lngLat: map.map.unproject([x, y]) });
      });
      await page.locator("#card").waitFor();
      assert.deepEqual(await found(page), [], "a line's card");
      await picture(page, `card-${where}`);
      await page.keyboard.press("?");
      await page.locator("#help").waitFor();
      assert.deepEqual(await found(page), [], "the keys");
      await page.screenshot({ path: `${process.env.SCREENSHOTS}/help-${where}.png` });
      await close();
    });
  }
}
