// Where the person looks from: orbit, pan, zoom. The same movements as in splatnode/viewer/state.py.
// A viewpoint is {T, distance, up, lens}: T is T_world_camera, 16 numbers by rows (camera x right, y down, z forward),
// the pivot lies `distance` ahead, and lens is {K (9 numbers by rows), size [width, height]}.

const STEEPEST = (85 * Math.PI) / 180; // of a viewing direction, from the horizontal
const NEAREST = 1e-3; // world units, of the pivot

export const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, factor) => a.map((value) => factor * value);
const unit = (a) => scaled(a, 1 / Math.max(Math.hypot(...a), 1e-12));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const column = (T, i) => [T[i], T[4 + i], T[8 + i]];

export const centre = (T) => column(T, 3);
export const forward = (T) => column(T, 2);
const pivot = (view) => add(centre(view.T), forward(view.T), view.distance);

/** Another T with its centre there. */
const moved = (T, to) => T.map((value, i) => (i % 4 === 3 && i < 12 ? to[(i - 3) / 4] : value));

function lookAt(from, target, up) {
  const ahead = unit(add(target, from, -1));
  let right = cross(ahead, up);
  if (Math.hypot(...right) < 1e-9) right = cross(ahead, [up[2], up[0], up[1]]); // straight up or down
  right = unit(right);
  const down = cross(ahead, right);
  const rows = [0, 1, 2].flatMap((i) => [right[i], down[i], ahead[i], from[i]]);
  return [...rows, 0, 0, 0, 1];
}

function rotated(vector, axis, angle) {
  const along = dot(axis, vector) * (1 - Math.cos(angle));
  const turned = add(scaled(vector, Math.cos(angle)), cross(axis, vector), Math.sin(angle));
  return add(turned, axis, along);
}

/** After a walk around the pivot: to the right around the world's up, then upwards, not over the pole. Radians. */
export function orbited(view, right, upwards) {
  const target = pivot(view);
  const outwards = scaled(add(centre(view.T), target, -1), 1 / view.distance);
  const elevation = Math.asin(clamp(dot(outwards, view.up), -1, 1));
  const steep = Math.abs(elevation) >= STEEPEST;
  const raised = steep ? elevation : clamp(elevation + upwards, -STEEPEST, STEEPEST);
  const turned = rotated(outwards, view.up, right);
  const flat = unit(add(turned, view.up, -dot(turned, view.up)));
  const direction = add(scaled(flat, Math.cos(raised)), view.up, Math.sin(raised));
  return { ...view, T: lookAt(add(target, direction, view.distance), target, view.up) };
}

/** After a drag of the scene by pixels: what is at the pivot's distance stays under the pointer. */
export function panned(view, rightPx, downPx, focalPx) {
  const step = view.distance / focalPx;
  const to = add(add(centre(view.T), column(view.T, 0), -step * rightPx), column(view.T, 1), -step * downPx);
  return { ...view, T: moved(view.T, to) };
}

/** With the distance to the pivot multiplied by `factor`. */
export function zoomed(view, factor) {
  const distance = Math.max(view.distance * factor, NEAREST);
  return { ...view, T: moved(view.T, add(pivot(view), forward(view.T), -distance)), distance };
}

/** {fx, fy, cx, cy, scale, left, top} for a window in which the lens's image lies in the middle, as large as it fits. */
export function fitted(lens, width, height) {
  const scale = Math.min(width / lens.size[0], height / lens.size[1]);
  const left = (width - scale * lens.size[0]) / 2;
  const top = (height - scale * lens.size[1]) / 2;
  const [fx, , cx, , fy, cy] = lens.K;
  return { fx: scale * fx, fy: scale * fy, cx: scale * cx + left, cy: scale * cy + top, scale, left, top };
}

/** Column-major T_camera_world, as WebGL takes it. */
export function fromWorld(T) {
  const rows = [0, 1, 2].map((i) => column(T, i)); // of T_camera_world: the columns of the rotation
  const shift = rows.map((row) => -dot(row, centre(T)));
  return new Float32Array([0, 1, 2].flatMap((j) => [rows[0][j], rows[1][j], rows[2][j], 0]).concat([...shift, 1]));
}

/** Pixel x, pixel y and z of a world point. */
export function projected(point, T, lens) {
  const offset = add(point, centre(T), -1);
  const [x, y, z] = [0, 1, 2].map((i) => dot(column(T, i), offset));
  return [(lens.fx * x) / z + lens.cx, (lens.fy * y) / z + lens.cy, z];
}
