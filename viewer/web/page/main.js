// The page: what is told becomes a scene, what the visitor does becomes a viewpoint. Nothing of it reaches the node.

import { fetchGaussians, fetchShapes, listen } from "/feed.js";
import { Panel } from "/panel.js";
import { Picture } from "/picture.js";
import { watch } from "/pointer.js";
import { add, centre, dot, fitted, forward, orbited, panned, projected, zoomed } from "/viewpoint.js";

const TRACKED = { colour: [0.2, 1.0, 0.3], width: 3 };
const AT_THE_EYE = 2; // times the depth of a frustum: a camera that near would fill the window
const CLICK_PX = 14; // around a camera's centre that are the camera

const canvas = document.getElementById("picture");
const over = document.getElementById("over");
const panel = new Panel(press, goTo, redraw);

let shapes = null; // what stands beside the Gaussians
let view = null; // the viewpoint; its lens is that of the camera whose viewpoint was last taken
let chosen = null; // the name of the camera whose viewpoint is taken
let touched = false; // whether the visitor has chosen a viewpoint
let tracked = []; // the ends of the live camera's lines
let linesShown = ""; // which lines the picture has
let wanted = { run: "", gaussians: 0, age: null, since: 0 };
let delay = null; // seconds from the node's message to the picture here

for (const name of ["tracked", "advice", "uncertainty", "graph"]) panel.offer(name, false); // nothing is there yet
let picture;
try {
  picture = new Picture(canvas, look, drawn, () => (delay = since()));
} catch (error) {
  panel.notice = error.message;
}
canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => location.reload());

const since = () => (wanted.age === null ? null : wanted.age + (performance.now() - wanted.since) / 1000);
const camera = () => shapes?.cameras.find(({ name }) => name === chosen) ?? null;

// ---- What is told ----------------------------------------------------------------------------------------------------

async function heard(news) {
  panel.notice = news.shapes || !picture ? "" : news.said.state ?? "";
  panel.say(news.said);
  if (JSON.stringify(tracked) !== JSON.stringify(news.said.tracked ?? [])) {
    tracked = news.said.tracked ?? [];
    panel.offer("tracked", tracked.length > 0);
    linesShown = "";
  }
  // Another run of the viewer counts its versions anew.
  const fresh = news.run !== wanted.run || news.gaussians !== wanted.gaussians;
  if (news.shapes && (shapes?.run !== news.run || shapes.version !== news.shapes)) await takeShapes(news.shapes, news.run);
  if (news.gaussians && fresh) {
    const file = await fetchGaussians(news.gaussians);
    if (file) {
      wanted = { run: news.run, gaussians: news.gaussians, age: news.age_s, since: performance.now() };
      picture?.splats.load(file, news.gaussians, view ? forward(view.T) : [0, 0, 1]);
    }
  }
  redraw();
}

async function takeShapes(version, run) {
  const fetched = await fetchShapes(version);
  if (!fetched) return;
  // A node's scene stays the same in another run, a result need not; photographs of one name may be others in both.
  const fresh = { ...fetched, run, scene: fetched.scene || run, album: `${run}\n${fetched.scene}` };
  if (shapes && shapes.scene !== fresh.scene) {
    [view, chosen, touched] = [null, null, false];
    over.removeAttribute("src");
  }
  shapes = fresh;
  linesShown = "";
  for (const name of ["advice", "uncertainty", "graph"])
    panel.offer(name, fresh.lines.some(({ group }) => group === name));
  panel.list(fresh.cameras.map(({ name }) => name));
  if (chosen && !camera()) chosen = null;
  if (!view || (!touched && !chosen)) start();
  picture?.photographs.fetch(fresh.album, fresh.cameras, version);
}

/** A photographed view, or, where nothing was photographed, all of the scene. */
function start() {
  overview();
  touched = false;
  if (shapes.cameras.length && !shapes.lines.some(({ group }) => group === "graph"))
    goTo(shapes.cameras[shapes.cameras.length >> 1].name);
}

// ---- Where the visitor looks from ------------------------------------------------------------------------------------

function overview() {
  const { T_world_camera, K, size, distance } = shapes.overview;
  view = { T: T_world_camera, distance, up: shapes.up, lens: { K, size } };
  chosen = null;
}

function goTo(name) {
  chosen = name;
  const there = camera();
  over.hidden = true;
  if (there?.photograph) over.src = `/photograph/${shapes.version}/${shapes.cameras.indexOf(there)}`;
  redraw();
}

/** The viewpoint that is shown: at a camera, its own, with the pivot as deep as the middle of the scene. */
function viewpoint() {
  const there = camera();
  if (!there || !view) return view;
  const T = there.T_world_camera;
  const depth = dot(add(shapes.pivot, centre(T), -1), forward(T));
  return { ...view, T, distance: Math.max(depth, 0.1), lens: { K: there.K, size: there.size } };
}

function move(change) {
  if (!view) return;
  [view, chosen, touched] = [change(viewpoint()), null, true];
  redraw(true);
}

function step(by) {
  const names = shapes?.cameras.map(({ name }) => name) ?? [];
  if (!names.length) return;
  const at = names.indexOf(chosen);
  goTo(names[at < 0 ? (by > 0 ? 0 : names.length - 1) : (at + by + names.length) % names.length]);
}

function press(key) {
  if (key === "r" && shapes) [touched] = [true, overview()];
  else if (key === "n" || key === "p") step(key === "n" ? 1 : -1);
  else if (key === "x" && chosen) move((now) => now);
  else if (panel.toggle(key)) linesShown = "";
  else return;
  redraw();
}

/** Goes to the camera that is seen at a pixel of the page: the one whose centre or photograph is nearest to the eye. */
function click(x, y) {
  const now = viewpoint();
  if (!now || !panel.shown.cameras) return;
  const lens = fitted(now.lens, canvas.clientWidth, canvas.clientHeight);
  const hits = visibleCameras(now).flatMap(({ name, T_world_camera, corners }) => {
    const [u, v, z] = projected(centre(T_world_camera), now.T, lens);
    const on = z > 0 && Math.hypot(u - x, v - y) < CLICK_PX;
    const outline = corners.map((corner) => projected(corner, now.T, lens));
    return on || isInside(outline, x, y) ? [{ name, z: Math.max(z, 0) }] : [];
  });
  if (hits.length) goTo(hits.reduce((a, b) => (a.z < b.z ? a : b)).name);
}

function isInside(outline, x, y) {
  if (outline.some(([, , z]) => z <= 0)) return false;
  const sides = outline.map(([u, v], i) => {
    const [nextU, nextV] = outline[(i + 1) % outline.length];
    return (nextU - u) * (y - v) - (nextV - v) * (x - u);
  });
  return sides.every((side) => side > 0) || sides.every((side) => side < 0);
}

// ---- What is drawn ---------------------------------------------------------------------------------------------------

function redraw(moving = false) {
  panel.choose(chosen);
  picture?.redraw(moving);
}

const visibleCameras = ({ T }) =>
  shapes.cameras.filter(
    ({ T_world_camera }) =>
      Math.hypot(...add(centre(T_world_camera), centre(T), -1)) > AT_THE_EYE * shapes.frustum_depth,
  );

function look() {
  const now = viewpoint();
  if (!now || !shapes) return null;
  const cameras = visibleCameras(now);
  chooseLines(new Set(cameras.map(({ name }) => name)));
  return { T: now.T, lens: now.lens, shown: panel.shown, album: shapes.album, cameras };
}

/** Hands the lines that are switched on to the picture, where they are others than before. */
function chooseLines(visible) {
  const key = [...visible].join("\n");
  if (linesShown === key && key) return;
  linesShown = key;
  const ofCameras = shapes.lines.filter(({ group }) => group === "cameras");
  const near = new Set(ofCameras.filter((_, index) => !visible.has(shapes.cameras[index].name)));
  const groups = shapes.lines.filter((lines) => panel.shown[lines.group] && !near.has(lines));
  const live = tracked.length && panel.shown.tracked ? [{ ...TRACKED, ends: tracked }] : [];
  const isGround = ({ group }) => group === "ground";
  picture.ground.set(groups.filter(isGround));
  picture.lines.set([...groups.filter((lines) => !isGround(lines)), ...live]);
}

/** Lays the photograph of the camera whose viewpoint is taken over the picture. */
function drawn() {
  const there = camera();
  over.hidden = !there?.photograph || panel.blend === 0 || !over.complete || !over.naturalWidth;
  if (!over.hidden) {
    const { scale, left, top } = fitted({ K: there.K, size: there.size }, canvas.clientWidth, canvas.clientHeight);
    const [width, height] = there.size.map((side) => scale * side);
    Object.assign(over.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
    over.style.opacity = panel.blend;
  }
  const { rate, splats } = picture;
  const parts = [];
  if (rate) parts.push(`${rate.toFixed(rate < 10 ? 1 : 0)} pictures/s while it moves`);
  if (delay !== null) parts.push(`shown ${delay.toFixed(1)} s after it came from the node`);
  panel.rate = parts.join(", ");
  const count = Number(document.body.dataset.pictures ?? 0) + 1;
  const facts = { pictures: count, gaussians: splats.count, camera: chosen ?? "", view: view ? centre(view.T).join(" ") : "" };
  Object.assign(document.body.dataset, facts);
}

// ---- Beginning -------------------------------------------------------------------------------------------------------

over.addEventListener("load", () => redraw());
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
  press(event.key.toLowerCase());
});
watch(canvas, {
  orbit: (right, up) => move((now) => orbited(now, right, up)),
  pan: (right, down) =>
    move((now) => panned(now, right, down, fitted(now.lens, canvas.clientWidth, canvas.clientHeight).fx)),
  zoom: (factor) => move((now) => zoomed(now, factor)),
  click,
});
listen(heard, (why) => (panel.notice = why));
