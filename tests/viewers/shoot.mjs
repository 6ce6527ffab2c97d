// Takes pictures of splat files in web viewers, in headless Chromium without a graphics card.
//
//   node shoot.mjs PAGES NODE_MODULES CHROMIUM < jobs.json
//
// jobs: [{viewer, file, out, view}, …]; view is what view.js reads, without its file. All is served from 127.0.0.1.
import { createReadStream, mkdtempSync, rmSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { extname, join, normalize } from "node:path";
import { text } from "node:stream/consumers";

const [pages, modules, chromium] = process.argv.slice(2);
const { chromium: browsers } = createRequire(join(modules, "anchor.js"))("playwright-core");

const VIEWERS = ["spark", "gaussian-splats-3d"];
const TYPES = { ".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm" };
const IMPORTS = {
  three: "/modules/three/build/three.module.js",
  "three/addons/": "/modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/modules/@sparkjsdev/spark/dist/spark.module.js",
  "@mkkellogg/gaussian-splats-3d":
    "/modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js",
};
const FLAGS = [
  "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
  "--force-color-profile=srgb", "--hide-scrollbars", "--no-first-run", "--disable-quic", "--disable-sync",
  "--disable-background-networking", "--disable-component-update",
];

const page = (viewer) => `<!doctype html>
<link rel="icon" href="data:,">
<style>html, body { margin: 0; background: #000; overflow: hidden } canvas { display: block }</style>
<script type="importmap">${JSON.stringify({ imports: IMPORTS })}</script>
<body><script type="module" src="/pages/${viewer}.js"></script>`;

function serve(jobs) {
  const roots = { pages, modules };
  return createServer((request, response) => {
    const [, root, ...rest] = decodeURIComponent(new URL(request.url, "http://x").pathname).split("/");
    if (root === "view" && VIEWERS.includes(rest[0])) {
      response.setHeader("Content-Type", "text/html");
      response.end(page(rest[0]));
      return;
    }
    const path = root === "file" ? jobs[parseInt(rest[0], 10)]?.file : root in roots && join(roots[root], normalize(rest.join("/")));
    if (!path || !statSync(path, { throwIfNoEntry: false })?.isFile()) {
      response.writeHead(404).end();
      return;
    }
    response.setHeader("Content-Type", TYPES[extname(path)] ?? "application/octet-stream");
    response.setHeader("Content-Length", statSync(path).size);
    createReadStream(path).pipe(response);
  });
}

async function shoot(context, origin, job, number) {
  const tab = await context.newPage();
  const said = [];
  tab.on("console", (message) => said.push(message.text()));
  tab.on("pageerror", (error) => said.push(String(error)));
  await tab.setViewportSize({ width: job.view.width, height: job.view.height });
  const view = { ...job.view, file: `${origin}/file/${number}${extname(job.file)}` };
  try {
    await tab.goto(`${origin}/view/${job.viewer}?view=${encodeURIComponent(JSON.stringify(view))}`);
    await tab.waitForFunction(() => window.outcome, null, { timeout: 120_000 });
    const outcome = await tab.evaluate(() => window.outcome);
    if (outcome !== "drawn") throw new Error(outcome);
    await tab.screenshot({ path: job.out });
  } catch (error) {
    throw new Error(`${job.viewer} ${job.file}: ${error.message}\n${said.join("\n")}`);
  } finally {
    await tab.close();
  }
}

const jobs = JSON.parse(await text(process.stdin));
const server = serve(jobs);
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const profile = mkdtempSync(join(tmpdir(), "viewers-"));
let failed = 0;
try {
  const context = await browsers.launchPersistentContext(profile, {
    executablePath: chromium, headless: true, args: FLAGS, deviceScaleFactor: 1,
  });
  for (const [number, job] of jobs.entries()) {
    await shoot(context, `http://127.0.0.1:${server.address().port}`, job, number);
  }
  await context.close();
} catch (error) {
  console.error(error.message);
  failed = 1;
} finally {
  server.close();
  server.closeAllConnections();
  rmSync(profile, { recursive: true, force: true });
}
process.exit(failed);
