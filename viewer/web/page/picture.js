// The picture: what is drawn in which order, at which resolution, and how often.

import { Lines } from "/lines.js";
import { Photographs } from "/photographs.js";
import { Splats } from "/splats.js";
import { fitted, forward, fromWorld } from "/viewpoint.js";

const BACKGROUND = [24 / 255, 26 / 255, 30 / 255];
const SLOW_MS = 80; // a picture that takes longer is drawn coarser while the viewpoint moves
const FAST_MS = 30;
const COARSEST = 0.3; // of the resolution
const STILL_MS = 250; // after the last movement, the picture is drawn in full
const RATE_MS = 2000; // over which the rate is taken
const POLL_MS = 4;
const POINT_PX = 3;

export class Picture {
  /** `look()` gives what to draw: {T, lens, shown, album, cameras}, or null; `drawn()` is called after each picture. */
  constructor(canvas, look, drawn, loaded) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2, which the picture needs. Another one, or another machine, may.");
    Object.assign(this, { canvas, gl, look, drawn });
    this.splats = new Splats(gl, (fresh) => (this.redraw(), fresh && loaded()));
    this.lines = new Lines(gl);
    this.ground = new Lines(gl); // which what lies on it hides
    this.photographs = new Photographs(gl, () => this.redraw());
    this.scale = 1; // of the resolution while the viewpoint moves
    this.movedAt = -Infinity;
    this.asked = false; // for another picture
    this.busy = false; // with one
    this.times = []; // when the pictures of the last seconds of one movement were done
    this.#clear();
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  /** Draws anew, soon. `moving`: the next picture will come at once. */
  redraw(moving = false) {
    if (moving) this.movedAt = performance.now();
    if (this.asked) return;
    this.asked = true;
    if (!this.busy) requestAnimationFrame(() => this.#draw());
  }

  /** Pictures in a second of the last movement; 0: not known. */
  get rate() {
    const { times } = this;
    return times.length > 1 ? (1000 * (times.length - 1)) / (times.at(-1) - times[0]) : 0;
  }

  #draw() {
    this.asked = false;
    const began = performance.now();
    const moving = began - this.movedAt < STILL_MS;
    const what = this.look();
    if (!what) return;
    const { canvas, gl } = this;
    const pixels = devicePixelRatio * (moving ? this.scale : 1);
    const width = Math.max(1, Math.round(canvas.clientWidth * pixels));
    const height = Math.max(1, Math.round(canvas.clientHeight * pixels));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const eye = { T_camera_world: fromWorld(what.T), lens: fitted(what.lens, width, height), width, height };
    this.splats.sort(forward(what.T));
    gl.viewport(0, 0, width, height);
    this.#clear();
    if (what.shown.photographs && what.shown.cameras) this.photographs.draw(eye, what.album, what.cameras);
    this.ground.draw(eye, pixels, false);
    this.lines.draw(eye, pixels, false);
    if (what.shown.gaussians) this.splats.draw(eye, what.shown.points ? POINT_PX * pixels : 0);
    this.lines.draw(eye, pixels, true);
    this.busy = true;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.#await(fence, () => this.#finish(began, moving));
  }

  #clear() {
    this.gl.clearColor(...BACKGROUND, 1);
    this.gl.clear(this.gl.COLOR_BUFFER_BIT | this.gl.DEPTH_BUFFER_BIT);
  }

  /** Calls `done` once the graphics processor is through with what came before the fence. */
  #await(fence, done) {
    const { gl } = this;
    if (!gl.isContextLost() && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED)
      setTimeout(() => this.#await(fence, done), POLL_MS);
    else {
      gl.deleteSync(fence);
      done();
    }
  }

  /** After a picture: learns how many pixels the machine can draw, and draws the next one if it was asked for. */
  #finish(began, moving) {
    const now = performance.now();
    const took = now - began;
    this.busy = false;
    if (moving) {
      if (began - this.times.at(-1) > STILL_MS) this.times = []; // another movement
      this.times = [...this.times.filter((time) => now - time < RATE_MS), now];
      if (took > SLOW_MS) this.scale = Math.max(COARSEST, this.scale * Math.max(0.5, Math.sqrt(SLOW_MS / took)));
      else if (took < FAST_MS) this.scale = Math.min(1, 1.05 * this.scale);
      clearTimeout(this.still);
      this.still = setTimeout(() => this.redraw(), STILL_MS);
    }
    this.drawn();
    if (this.asked) requestAnimationFrame(() => this.#draw());
  }
}
