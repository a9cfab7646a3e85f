// page.mjs URL PICTURE [POSTS.json]: the page in headless Chromium. Fails on an error in its console, and on a request to
// another machine; with posts ([[longitude, latitude, height], ...]) tells how far the finest terrain is from them.
import { createRequire } from "node:module";
import { readFileSync } from "node:fs";
const { chromium } = createRequire(process.env.TALUS_NPM + "/")("playwright-core");
const [url, picture, posts] = process.argv.slice(2);
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM || "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"] });
const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
const faults = [], outside = [];
// the page asks for one index, then for the other
const asked = m => /\/(layer|tileset)\.json/.test(m.location().url) && / 404 /.test(m.text());
page.on("console", m => m.type() === "error" && !asked(m) && faults.push(m.text()));
page.on("pageerror", e => faults.push(String(e)));
page.on("request", r => {
    const at = new URL(r.url());
    if (!["127.0.0.1", "localhost"].includes(at.hostname) && ["http:", "https:", "ws:", "wss:"].includes(at.protocol))
        outside.push(r.url());
});
await page.goto(url);
await page.waitForFunction(() => window.rest || window.failed, null, { timeout: 240000 });
const trouble = await page.evaluate(() => window.failed || "");
await page.screenshot({ path: picture, timeout: 120000 });
let off = null;
if (posts)
    off = await page.evaluate(async list => {
        const at = list.map(p => Cesium.Cartographic.fromDegrees(p[0], p[1]));
        if (window.tileset)
            await window.viewer.scene.sampleHeightMostDetailed(at);
        else
            await Cesium.sampleTerrainMostDetailed(window.viewer.terrainProvider, at);
        const d = at.map((p, k) => Math.abs(p.height - list[k][2]));
        return { worst: Math.max(...d), mean: d.reduce((a, b) => a + b) / d.length, posts: d.length };
    }, JSON.parse(readFileSync(posts)));
await browser.close();
console.log(JSON.stringify({ trouble, faults, outside, off }));
process.exit(trouble || faults.length || outside.length ? 1 : 0);
