// Recordings: the page makes one, plays it into another room, and its play bar stops, seeks and goes on.
import { check, difference, faceIsThere, launch, live, open, picture, roomName, run, text, until } from "./lib.mjs";

// Drawing takes software all the time there is: only the page whose picture is looked at draws, the others have controls alone.
const UNDRAWN = "backend=none";
const controlsAreThere = (page) => until("the controls", () => page.evaluate(() => Boolean(document.querySelector("#slider-shape-browInnerUp"))));

await run(async () => {
  const browser = await launch();
  const [room, stage] = [roomName("take"), roomName("stage")];

  // A face that is moved by hand.
  const { page, errors } = await open(browser, `/?room=${room}&${UNDRAWN}`, { size: { width: 800, height: 480 } });
  await controlsAreThere(page);
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-puppet");
  await page.locator("#slider-shape-browInnerUp").fill("0.01");
  const listed = new URL(`/api/rooms?room=${room}`, page.url()).href;
  await until("a publisher", async () => (await (await page.request.get(listed)).json()).rooms[0]?.publisher);
  await until("the record button", () => page.isVisible("#record-button"));
  check("nothing is recorded at first", (await page.getAttribute("#record-button", "aria-pressed")) === "false");
  await page.click("#record-button");
  await until("the recording", async () => (await page.getAttribute("#record-button", "aria-pressed")) === "true");
  check("the button says that it records", true);
  await page.waitForTimeout(2500);
  await page.locator("#slider-shape-browInnerUp").fill("1");
  await page.locator("#slider-shape-browOuterUpLeft").fill("1");
  await page.waitForTimeout(2500);
  await page.click("#tab-takes");
  await until("the recording's length", async () => /^Recording: \d+:\d\d\.\d, [\d.]+ [kM]B$/.test(await text(page, "#take-text")));
  check("the page of takes says how long it is", true);
  await page.click("#take-button");
  await until("the end of the recording", async () => (await page.getAttribute("#record-button", "aria-pressed")) === "false");
  const file = await until("a recording in the list", () => page.getAttribute("#take-list [data-file]", "data-file"));
  check("its file is named after the room", file.startsWith(`${room}-`), file);
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await page.close();

  // Another room, where it is played.
  const watching = await open(browser, `/?room=${stage}&bare=1&view=wireframe`, { size: { width: 320, height: 240 } });
  await faceIsThere(watching.page);
  check("a bare page has no play bar", !(await watching.page.isVisible("#play")));
  const player = await open(browser, `/?room=${stage}&${UNDRAWN}`, { size: { width: 800, height: 480 } });
  await controlsAreThere(player.page);
  check("nothing is replayed at first", !(await player.page.isVisible("#play")));
  if (!(await player.page.isVisible("#panel"))) await player.page.keyboard.press("h");
  await player.page.click("#tab-takes");
  // While somebody performs there, the page says so.
  await player.page.evaluate((name) => new Promise((ready) => {
    const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/v1/rooms/${name}/publish`, "rhytid.v1");
    socket.onopen = () => socket.send('{"type":"hello","version":1,"source":"test"}');
    socket.onmessage = ready;
    window.performer = socket;
  }), stage);
  await player.page.click(`#take-list [data-file="${file}"]`);
  await until("a refusal in words", async () => (await text(player.page, "#take-problem")).includes("publisher already"));
  check("a room with a publisher is not taken over", !(await player.page.isVisible("#play")));
  await player.page.evaluate(() => window.performer.close());
  await player.page.waitForTimeout(500);
  await player.page.click(`#take-list [data-file="${file}"]`);
  await until("the play bar", () => player.page.isVisible("#play"));
  await live(watching.page);
  check("the other page's face is live", true);

  const place = async () => Number(await player.page.locator("#play-position").inputValue());
  const length = Number(await player.page.getAttribute("#play-position", "max"));
  check(`the recording is as long as it took (${length.toFixed(1)} s)`, length > 4.5 && length < 300);
  // To its end, where the player stays; quickly, as a slow machine's takes are long.
  await player.page.selectOption("#play-speed", "4");
  await until("the end", async () => (await player.page.getAttribute("#play", "data-playing")) === "false");
  check("it stands still at its end", Math.abs((await place()) - length) < 0.1, String(await place()));

  // Scrubbing.
  const scrub = async (fraction) => {
    const box = await player.page.locator("#play-position").boundingBox();
    await player.page.mouse.move(box.x + box.width * 0.5, box.y + box.height / 2);
    await player.page.mouse.down();
    await player.page.mouse.move(box.x + box.width * (fraction + 0.5) / 2, box.y + box.height / 2);
    await player.page.mouse.move(box.x + 8 + (box.width - 16) * fraction, box.y + box.height / 2);
    await player.page.mouse.up();
    await player.page.waitForTimeout(300);
  };
  const status = async () => (await (await player.page.request.get(new URL(`/api/rooms/${stage}/replay`, player.page.url()).href)).json()).replay;
  await scrub(0.95);
  const raised = await until("the late face", async () => Math.abs((await status()).position - 0.95 * length) < 0.1 * length && picture(watching.page));
  await watching.page.waitForTimeout(1500);
  const late = await picture(watching.page);
  await scrub(0.2);
  // A busy page sends the last place late.
  await until("the place that the slider was dragged to", async () => Math.abs((await status()).position - 0.2 * length) < 0.06 * length, 30_000);
  check("the player stands where the slider was dragged to", true);
  check("it stands still, as before", (await status()).playing === false);
  await until("the early face in the other page's picture", async () => difference(late, await picture(watching.page), [0.2, 0, 0.8, 1]) > 0.5, 40_000);
  check("dragging shows another face to whoever watches", raised !== null);

  // Play, speed, again and again, and the space bar.
  await player.page.selectOption("#play-speed", "0.25");
  await player.page.click("#play-button");
  await until("it to move", async () => (await status()).playing && (await status()).speed === 0.25);
  // By the page's own clock: on a busy machine everything between takes its time.
  const [moved, took] = await player.page.evaluate(async () => {
    const slider = document.querySelector("#play-position");
    const [from, since] = [Number(slider.value), performance.now()];
    await new Promise((done) => setTimeout(done, 4000));
    return [Number(slider.value) - from, (performance.now() - since) / 1000];
  });
  check(`a quarter of the speed moves the slider by a quarter (${moved.toFixed(2)} s in ${took.toFixed(2)} s)`, moved > 0.12 * took && moved < 0.5 * took);
  await player.page.click("#play-loop");
  await until("again and again", async () => (await status()).loop);
  await player.page.locator("#face").focus();
  await player.page.keyboard.press(" ");
  await until("a stop by the space bar", async () => !(await status()).playing);
  await until("the button saying so", async () => (await player.page.getAttribute("#play-button", "aria-label")) === "Play");
  check("the space bar stops it", true);
  await player.page.locator("#play-position").focus();
  await player.page.keyboard.press("Home");
  await until("the beginning", async () => (await status()).position < 0.05);
  check("the slider obeys keys", true);
  if (process.env.RHYTID_SHOTS) await player.page.screenshot({ path: `${process.env.RHYTID_SHOTS}/takes.png` });
  await player.page.click("#play-end");
  await until("the bar gone", async () => !(await player.page.isVisible("#play")));
  await until("the other page's face gone", async () => (await text(watching.page, "#state-text")) !== "Live");
  check("the replay ends", (await status()) === null);
  // A refusal is an answer of 409, which browsers call an error.
  const said = [...player.errors.filter((error) => !error.includes("409")), ...watching.errors];
  check("these pages' consoles say nothing of errors", said.length === 0, said.join("; "));

  const phone = await open(browser, `/?room=${stage}&${UNDRAWN}`, { size: { width: 390, height: 844 } });
  const again = await phone.page.request.post(new URL(`/api/rooms/${stage}/replay`, phone.page.url()).href, { data: { file, loop: true } });
  check("it can be played again", again.ok(), await again.text());
  await until("the play bar on a phone", () => phone.page.isVisible("#play"));
  const fits = await phone.page.evaluate(() => [...document.querySelectorAll("#play *")].every((part) => part.getBoundingClientRect().right <= innerWidth) && document.documentElement.scrollWidth <= innerWidth);
  check("the play bar fits a phone", fits);
  if (process.env.RHYTID_SHOTS) await phone.page.screenshot({ path: `${process.env.RHYTID_SHOTS}/takes-phone.png` });
  await browser.close();
});
