// The page: it loads, rooms switch, keys and sliders do what they say, a phone has room for it.
import { check, difference, faceIsThere, launch, live, open, picture, roomName, run, text, until } from "./lib.mjs";

await run(async () => {
  const browser = await launch();
  const room = roomName("page");

  const viewer = await open(browser, `/?room=${room}&bare=1`);
  await faceIsThere(viewer.page);
  check("a bare page shows no controls", !(await viewer.page.isVisible("#bar")) && !(await viewer.page.isVisible("#dock")));

  const { page, errors } = await open(browser, `/?room=${room}`);
  await faceIsThere(page);
  check("the page names its room", (await text(page, "#room-name")) === room);
  await until("Waiting", async () => (await text(page, "#state-text")) === "Waiting for a face");
  check("an empty room is said to be waiting", true);
  check("there are views to choose", (await page.locator("#views button").count()) >= 6);

  // Keys: the same as in the native window.
  await page.keyboard.press("2");
  check("key 2 shows the bare face", (await page.locator('#views [aria-checked="true"]').textContent()) === "Bare");
  await page.keyboard.press("1");
  await page.keyboard.press("w");
  check("key W switches the wrinkles off", (await page.locator("#wrinkles").inputValue()) === "off");
  await page.keyboard.press("w");
  check("key W switches them on again", (await page.locator("#wrinkles").inputValue()) === "own");
  await page.keyboard.press("?");
  check("key ? opens the list of keys", await page.isVisible("#help"));
  await page.keyboard.press("Escape");

  // The puppeteer.
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-puppet");
  check("there are 52 sliders of shapes", (await page.locator('[id^="slider-shape-"]').count()) === 52);
  await page.uncheck("text=Both sides together");
  // From a face that is published, so that both pictures are of a live one.
  await page.locator("#slider-shape-browOuterUpLeft").fill("0.01");
  await live(viewer.page);
  await viewer.page.waitForTimeout(1500);
  const before = await picture(viewer.page);
  await page.locator("#slider-shape-browOuterUpLeft").fill("1");
  // The character's left brow is at the right of the picture.
  const moved = await until("a moved brow in the other page's picture", async () => {
    const after = await picture(viewer.page);
    const [left, right] = [difference(before, after, [0.1, 0, 0.5, 0.6]), difference(before, after, [0.5, 0, 0.9, 0.6])];
    return right > 0.4 && right > 2 * left ? { left, right } : null;
  }, 40_000);
  check(`the left brow's slider moves the right half of the picture (${moved.right.toFixed(2)} against ${moved.left.toFixed(2)} grey levels)`, true);
  check("the page says who moves the face", (await text(page, "#page-puppet .publish p")).startsWith(`You move the face of room ${room}`));
  await page.click("text=Reset");
  await until("the face back at rest", async () => difference(before, await picture(viewer.page), [0.5, 0, 0.9, 0.6]) < 0.2, 40_000);
  check("reset brings the face back", true);
  await page.locator("#slider-pose-stretch").fill("1");
  await until("a face in the reference pose", async () => difference(before, await picture(viewer.page), [0.1, 0, 0.9, 0.6]) > 0.4, 40_000);
  check("a reference pose moves the face", true);

  // The inspector follows.
  await page.click("#tab-inspect");
  await until("measured stages", async () => /Publish → arrive.*\d (ms|µs)/s.test(await text(page, "#page-inspect .stages")));
  check("the inspector measures the way from this browser back to it", true);

  // Another room.
  await page.click("#room-button");
  await page.waitForSelector(`#room-list [data-room="${room}"]`);
  check("the picker lists the room", true);
  await page.fill("#room-input", "not a room");
  await page.click("#room-form button");
  check("a name that cannot be one is refused in words", await page.isVisible("#room-problem"));
  const other = roomName("other");
  await page.fill("#room-input", other);
  await page.click("#room-form button");
  await until("the other room", async () => (await text(page, "#room-name")) === other);
  check("the address follows the room", new URL(page.url()).searchParams.get("room") === other);
  await page.goBack();
  await until("the first room again", async () => (await text(page, "#room-name")) === room);
  check("going back goes back to the first room", true);

  check("the console says nothing of errors", errors.length + viewer.errors.length === 0, [...errors, ...viewer.errors].join("; "));
  await page.close();
  await viewer.page.close();

  const phone = await open(browser, `/?room=${room}`, { size: { width: 390, height: 844 } });
  await faceIsThere(phone.page);
  check("a phone's page does not scroll sideways", await phone.page.evaluate(() => document.documentElement.scrollWidth <= innerWidth));
  const inside = await phone.page.evaluate(() => [...document.querySelectorAll("#bar button")].filter((button) => button.getClientRects().length).every((button) => {
    const box = button.getBoundingClientRect();
    return box.left >= 0 && box.right <= innerWidth && box.height >= 36;
  }));
  check("the bar's buttons are all on a phone's page and large enough", inside);
  await phone.page.click("#panel-button");
  check("the controls open on a phone", await phone.page.isVisible("#panel"));

  const clear = await open(browser, `/?room=${room}&bare=1&background=transparent`);
  await faceIsThere(clear.page);
  const background = await clear.page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  check("a page for browser sources has no ground", background === "rgba(0, 0, 0, 0)", background);
  await browser.close();
});
