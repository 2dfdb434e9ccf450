// Measures viewers: node bench.mjs FOLDER WIDTHxHEIGHT ROUNDS. FOLDER holds scene.ply, scene.html and
// camera.json.
import { createServer } from "node:http";
import { readFile } from "node:fs/promises";
import { dirname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";
import { installed, launch } from "./browser.mjs";

const HERE = dirname(fileURLToPath(import.meta.url));
const [folder, shape, rounds] = process.argv.slice(2);
const [width, height] = shape.split("x").map(Number);
/// Time of a drag and of the pause before it, ms.
const DRAG = 8000, PAUSE = 6000;
const TYPES = { html: "text/html", js: "text/javascript", mjs: "text/javascript", css: "text/css", json: "application/json", wasm: "application/wasm" };

if (!installed()) {
  console.log("SKIPPED: no Chromium here; install the package chromium, or name the program in CHROMIUM");
  process.exit(0);
}

/// First camera, OpenCV axes: position, a point ahead, vertical field of view in degrees.
const camera = JSON.parse(await readFile(join(folder, "camera.json"), "utf8"));

const three = (body) => `<!doctype html><meta charset="utf-8"><style>body { margin: 0; overflow: hidden } canvas, #root { width: 100vw; height: 100vh; display: block }</style>
<div id="root"></div><script type="importmap">{ "imports": { "three": "/node_modules/three/build/three.module.js", "three/addons/": "/node_modules/three/examples/jsm/",
"spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js", "mkkellogg": "/node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js" } }</script>
<script type="module">${body}</script>`;

const pages = {
  "/spark.html": three(`
    import * as THREE from "three";
    import { OrbitControls } from "three/addons/controls/OrbitControls.js";
    import { SplatMesh, SparkRenderer } from "spark";
    const renderer = new THREE.WebGLRenderer({ antialias: false });
    renderer.setSize(innerWidth, innerHeight);
    document.getElementById("root").append(renderer.domElement);
    const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(${camera.fov}, innerWidth / innerHeight, 0.01, 1000);
    scene.add(new SparkRenderer({ renderer }));
    camera.up.set(0, -1, 0);
    camera.position.set(${camera.at});
    const controls = new OrbitControls(camera, renderer.domElement);
    controls.target.set(${camera.to});
    controls.update();
    const mesh = new SplatMesh({ url: "/scene.ply" });
    scene.add(mesh);
    await mesh.initialized;
    renderer.setAnimationLoop(() => { controls.update(); renderer.render(scene, camera); });
    window.ready = true;`),
  "/mkkellogg.html": three(`
    import * as GS from "mkkellogg";
    const viewer = new GS.Viewer({ rootElement: document.getElementById("root"), cameraUp: [0, -1, 0], initialCameraPosition: [${camera.at}],
      initialCameraLookAt: [${camera.to}], sharedMemoryForWorkers: false });
    await viewer.addSplatScene("/scene.ply", { showLoadingUI: false, splatAlphaRemovalThreshold: 1 });
    viewer.camera.fov = ${camera.fov};
    viewer.camera.updateProjectionMatrix();
    viewer.start();
    window.ready = true;`),
  "/settings.json": JSON.stringify({
    version: 2, tonemapping: "none", highPrecisionRendering: false, background: { color: [0, 0, 0] }, animTracks: [], annotations: [], startMode: "default",
    postEffectSettings: {}, camera: { fov: camera.fov },
    // The viewer turns the splats by 180° about z.
    cameras: [{ initial: { position: camera.at.map((v, k) => (k < 2 ? -v : v)), target: camera.to.map((v, k) => (k < 2 ? -v : v)), fov: camera.fov } }],
  }),
};

const server = createServer(async (request, reply) => {
  const path = new URL(request.url, "http://127.0.0.1").pathname;
  try {
    const file = path.startsWith("/scene.") ? join(folder, path) : path.startsWith("/supersplat/")
      ? join(HERE, "node_modules/@playcanvas/supersplat-viewer/public", path.slice(12)) : join(HERE, normalize(path));
    const text = pages[path] ?? await readFile(file);
    reply.writeHead(200, { "Content-Type": TYPES[path.split(".").pop()] ?? "application/octet-stream" });
    reply.end(text);
  } catch {
    reply.writeHead(404).end();
  }
}).listen(0, "127.0.0.1");
await new Promise((go) => server.on("listening", go));
const base = `http://127.0.0.1:${server.address().port}`;

const viewers = [
  { name: "splatvk", url: "/scene.html", ready: "splatvk.ready.then(() => true)" },
  { name: "Spark 2.2.0", url: "/spark.html", ready: "window.ready" },
  { name: "GaussianSplats3D 0.4.7", url: "/mkkellogg.html", ready: "window.ready" },
  { name: "SuperSplat Viewer 1.36.2", url: "/supersplat/index.html?content=/scene.ply&settings=/settings.json&webgl&noui&noanim", ready: "document.querySelector('canvas') && performance.now() > 15000" },
];

/// Frame times of a drag, ms: the time between animation frames, which wait for the picture before.
async function measure(browser, { name, url, ready }, round) {
  const page = await browser.newPage({ viewport: { width, height } });
  const errors = [];
  page.on("pageerror", (e) => errors.push(e.message));
  await page.goto(base + url);
  try {
    await page.waitForFunction(ready, undefined, { timeout: 90_000 });
  } catch {
    throw new Error(`${name} does not start: ${errors[0] ?? "no error"}`);
  }
  await page.waitForTimeout(PAUSE);
  const session = await page.context().newCDPSession(page);
  const mouse = (type, x, y) => session.send("Input.dispatchMouseEvent", { type, x, y, button: "left", buttons: type === "mouseReleased" ? 0 : 1, clickCount: 1 }).catch(() => {});
  const [cx, cy] = [width / 2, height / 2];
  mouse("mousePressed", cx, cy);
  await page.evaluate(() => {
    window.frameTimes = [];
    let last = performance.now();
    const note = (now) => {
      window.frameTimes.push(now - last);
      last = now;
      window.noting = requestAnimationFrame(note);
    };
    window.noting = requestAnimationFrame(note);
  });
  const begun = Date.now();
  while (Date.now() - begun < DRAG) {
    const t = (Date.now() - begun) / 1000;
    // The browser merges the moves that a frame does not see; none is waited for.
    mouse("mouseMoved", cx + 0.15 * width * Math.sin(2 * t), cy + 0.08 * height * Math.sin(1.3 * t));
    await new Promise((go) => setTimeout(go, 16));
  }
  const times = await page.evaluate(() => (cancelAnimationFrame(window.noting), window.frameTimes.slice(1)));
  if (process.env.KEEP && round === 0) await page.screenshot({ path: join(process.env.KEEP, `${name.replace(/\W+/g, "-")}.png`) });
  mouse("mouseReleased", cx, cy);
  await page.close();
  return times;
}

const quantile = (list, share) => [...list].sort((a, b) => a - b)[Math.min(list.length - 1, Math.floor(share * list.length))];
const all = new Map(viewers.map((v) => [v.name, []]));
for (let round = 0; round < Number(rounds); round++) {
  for (const viewer of viewers) {
    const browser = await launch();
    try {
      all.get(viewer.name).push(await measure(browser, viewer, round));
    } catch (error) {
      console.error(`${viewer.name}: ${error.message}`);
    }
    await browser.close();
  }
}
server.close();
console.log(`${width} x ${height}, ${rounds} rounds of ${DRAG / 1000} s; milliseconds per frame while dragging, median of the rounds' medians`);
for (let [name, list] of all) {
  list = list.filter((times) => times.length);
  if (!list.length) continue;
  const [medians, slow] = [0.5, 0.95].map((share) => list.map((times) => quantile(times, share)));
  console.log(`${name.padEnd(26)} median ${quantile(medians, 0.5).toFixed(0).padStart(5)}   95 % ${quantile(slow, 0.5).toFixed(0).padStart(5)}   frames ${list.map((t) => t.length).join(", ")}`);
}
