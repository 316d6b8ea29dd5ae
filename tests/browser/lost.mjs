// A graphics device that is taken away: the page says so and comes back with the face by itself, again and again.
import { actor, check, difference, faceIsThere, launch, live, open, picture, roomName, run, text, until } from "./lib.mjs";

await run(async () => {
  const room = roomName("lost");
  const browser = await launch();
  const { page, errors } = await open(browser, `/?room=${room}&bare=1&backend=webgl&view=bare`, { size: { width: 320, height: 320 } });
  await faceIsThere(page);
  const performer = await actor(browser, room, { source: "test" });
  await performer.make("jaw_open");
  await live(page);
  await page.waitForTimeout(1500);
  const before = await picture(page);
  for (const time of ["first", "second"]) {
    // What the notice says is seen even where it is gone again soon.
    const said = page.evaluate(() => new Promise((resolve) => {
      const notice = document.getElementById("notice");
      const look = () => {
        if (!notice.hidden && document.getElementById("notice-title").textContent === "Drawing again") resolve(notice.textContent);
      };
      new MutationObserver(look).observe(notice, { attributes: true, childList: true, subtree: true });
      window.old = document.getElementById("face");
      window.old.getContext("webgl2").getExtension("WEBGL_lose_context").loseContext();
    }));
    check(`the ${time} loss is said`, (await said).includes("took the graphics device away"), await said);
    await until("another canvas", () => page.evaluate(() => document.getElementById("face") !== window.old));
    await live(page);
    await until("the same face", async () => difference(before, await picture(page)) < 0.5);
    check(`after the ${time} one the same face is drawn in the same view`, (await page.locator('#views [aria-checked="true"]').textContent()) === "Bare");
  }
  check("the notice is gone", !(await page.isVisible("#notice")));
  check("the page was not loaded again", await page.evaluate(() => Boolean(window.old)));
  check("its state is Live", (await text(page, "#state-text")) === "Live");
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
