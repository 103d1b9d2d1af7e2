// Mouse, pen and fingers over the picture.

const TURN_PER_PIXEL = 0.006; // radians
const ZOOM_PER_NOTCH = 0.88;
const NOTCH_PX = 100; // of a wheel
const CLICK_PX = 4; // a pointer that moves less between press and release clicks

const middleOf = (points) => [0, 1].map((i) => points.reduce((sum, at) => sum + at[i], 0) / points.length);
const spreadOf = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/** Calls `moves` {orbit(right, up), pan(rightPx, downPx), zoom(factor), click(x, y)}; pixels are those of the page. */
export function watch(canvas, moves) {
  const down = new Map(); // where each pointer is
  let pressed = null; // where the first of them went down, null once it has dragged
  const place = (event) => [event.offsetX, event.offsetY];

  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, place(event));
    pressed = down.size === 1 ? place(event) : null;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = [...down.values()];
    if (pressed && spreadOf([pressed, place(event)]) < CLICK_PX) return;
    pressed = null;
    down.set(event.pointerId, place(event));
    const after = [...down.values()];
    const [right, downwards] = middleOf(after).map((value, i) => value - middleOf(before)[i]);
    if (after.length > 1) {
      moves.pan(right, downwards);
      moves.zoom(spreadOf(before) / Math.max(spreadOf(after), 1));
    } else if (event.buttons & 2 || event.shiftKey) moves.pan(right, downwards);
    else moves.orbit(-TURN_PER_PIXEL * right, TURN_PER_PIXEL * downwards);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      down.delete(event.pointerId);
      if (pressed && name === "pointerup") moves.click(...pressed);
      pressed = null;
    });
  }
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaMode === 1 ? 33 * event.deltaY : event.deltaY;
      moves.zoom(ZOOM_PER_NOTCH ** (-pixels / NOTCH_PX));
    },
    { passive: false },
  );
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}
