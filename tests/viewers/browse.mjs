// Opens pages in headless Chromium without a graphics card, as it is told line by line.
//
//   node browse.mjs NODE_MODULES CHROMIUM
//
// A job a line on standard input: {url, width, height, lit, clicks, evaluate, canvas, out}; an answer a line on standard
// output.
// lit: wait until so much of the largest canvas is not black. clicks: labels of what is pressed then, in order.
// evaluate: what is asked of the page then. canvas, out: files for what the largest canvas, and the page (whole: all of
// it), show at last. The answer: {said: what the console complained of, foreign: addresses other
// than the page's own, lit_at_ms: when the canvas was lit, value}, or {error}.
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

const [modules, chromium] = process.argv.slice(2);
const { chromium: browsers } = createRequire(join(modules, "anchor.js"))("playwright-core");
const FLAGS = [
  "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
  "--force-color-profile=srgb", "--hide-scrollbars", "--no-first-run", "--disable-quic", "--disable-sync",
  "--disable-background-networking", "--disable-component-update",
];
const OURS = ["data:", "blob:", "file:", "about:"];

// Share of the largest canvas that is not black, 0..1, by a small copy of it.
function litShare() {
  const canvas = [...document.querySelectorAll("canvas")].sort((a, b) => b.width - a.width)[0];
  if (!canvas || !canvas.width) return 0;
  const small = document.createElement("canvas");
  [small.width, small.height] = [64, 48];
  const drawing = small.getContext("2d");
  drawing.drawImage(canvas, 0, 0, 64, 48);
  const { data } = drawing.getImageData(0, 0, 64, 48);
  let lit = 0;
  for (let i = 0; i < data.length; i += 4) lit += data[i] + data[i + 1] + data[i + 2] > 24;
  return lit / (64 * 48);
}

// What the largest canvas shows, as PNG in base64. Its drawing buffer must be preserved.
function canvasData() {
  const canvas = [...document.querySelectorAll("canvas")].sort((a, b) => b.width - a.width)[0];
  return canvas.toDataURL("image/png").split(",")[1];
}

// What ``look`` gives once it is the same twice, a second apart.
async function atRest(tab, look) {
  for (let before = "", tries = 0; tries < 60; tries += 1) {
    const now = await look();
    if (now === before) return Buffer.from(now, "base64");
    before = now;
    await tab.waitForTimeout(1000);
  }
  throw new Error("the page does not come to rest");
}

async function browse(context, job) {
  const tab = await context.newPage();
  const said = [], foreign = [];
  tab.on("console", (message) => ["error", "warning"].includes(message.type()) && said.push(message.text()));
  tab.on("pageerror", (error) => said.push(String(error)));
  tab.on("request", (request) => {
    const address = request.url();
    if (!OURS.some((kind) => address.startsWith(kind)) && new URL(address).host !== new URL(job.url).host) foreign.push(address);
  });
  try {
    tab.setDefaultTimeout(120_000);
    await tab.setViewportSize({ width: job.width, height: job.height });
    await tab.goto(job.url);
    let lit_at_ms = null;
    if (job.lit) {
      await tab.waitForFunction(`(${litShare})() >= ${job.lit}`, null, { timeout: 60_000, polling: 200 });
      lit_at_ms = Date.now();
    }
    for (const label of job.clicks ?? []) await tab.getByText(label, { exact: true }).first().click();
    const value = job.evaluate ? await tab.evaluate(job.evaluate) : null;
    if (job.canvas) writeFileSync(job.canvas, await atRest(tab, () => tab.evaluate(`(${canvasData})()`)));
    if (job.out) {
      const options = { fullPage: Boolean(job.whole), timeout: 120_000 };
      writeFileSync(job.out, await atRest(tab, async () => (await tab.screenshot(options)).toString("base64")));
    }
    return { said, foreign, lit_at_ms, value };
  } catch (error) {
    return { error: `${error.message}\n${said.join("\n")}` };
  } finally {
    await tab.close();
  }
}

const profile = mkdtempSync(join(tmpdir(), "viewers-"));
const context = await browsers.launchPersistentContext(profile, {
  executablePath: chromium, headless: true, args: FLAGS, deviceScaleFactor: 1,
});
console.log("ready");
try {
  for await (const line of createInterface({ input: process.stdin })) {
    console.log(JSON.stringify(await browse(context, JSON.parse(line))));
  }
} finally {
  await context.close();
  rmSync(profile, { recursive: true, force: true });
}
