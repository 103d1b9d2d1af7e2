// Beside the page: makes a texture of a .splat file, and sorts its Gaussians by depth, the farthest first.

const BYTES = 32; // of a Gaussian: float32 xyz, float32 scales, uint8 RGBA, uint8 quaternion wxyz (q * 128 + 128)
const WIDTH = 1024; // Gaussians in a row of the texture
const NUMBERS = 12; // of a Gaussian there: xyz and RGBA, then the covariance's six, then two that nobody reads
const BINS = 1 << 16;

let positions = new Float32Array(0);
let version = 0;

onmessage = ({ data }) => {
  if (data.file) {
    version = data.version;
    const texture = load(data.file);
    const order = sorted(data.direction);
    postMessage({ version, texture, order, count: positions.length / 3, width: WIDTH }, [texture.buffer, order.buffer]);
  } else {
    const order = sorted(data.direction);
    postMessage({ version, order, count: positions.length / 3, width: WIDTH }, [order.buffer]);
  }
};

function load(file) {
  const count = Math.floor(file.byteLength / BYTES);
  const floats = new Float32Array(file);
  const words = new Uint32Array(file);
  const bytes = new Uint8Array(file);
  const texture = new Float32Array(NUMBERS * WIDTH * Math.max(1, Math.ceil(count / WIDTH)));
  const colours = new Uint32Array(texture.buffer);
  positions = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const from = 8 * i;
    const to = NUMBERS * i;
    for (let axis = 0; axis < 3; axis++) positions[3 * i + axis] = texture[to + axis] = floats[from + axis];
    colours[to + 3] = words[from + 6];
    covariance(floats, from + 3, bytes, 4 * from + 28, texture, to + 4);
  }
  return colours;
}

/** xx, xy, xz, yy, yz, zz of R diag(scales)^2 R'. */
function covariance(floats, scalesAt, bytes, quatAt, out, at) {
  let [w, x, y, z] = [0, 1, 2, 3].map((i) => (bytes[quatAt + i] - 128) / 128);
  const length = Math.hypot(w, x, y, z) || 1;
  w /= length;
  x /= length;
  y /= length;
  z /= length;
  const R = [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
  for (let axis = 0; axis < 3; axis++) {
    const variance = floats[scalesAt + axis] ** 2;
    let to = at;
    for (let i = 0; i < 3; i++) for (let j = i; j < 3; j++) out[to++] += variance * R[3 * i + axis] * R[3 * j + axis];
  }
}

/** The Gaussians' numbers, the farthest along `direction` first: a counting sort by depth in BINS steps. */
function sorted([x, y, z]) {
  const count = positions.length / 3;
  const depths = new Float32Array(count);
  let least = Infinity;
  let most = -Infinity;
  for (let i = 0; i < count; i++) {
    const depth = x * positions[3 * i] + y * positions[3 * i + 1] + z * positions[3 * i + 2];
    depths[i] = depth;
    if (depth < least) least = depth;
    if (depth > most) most = depth;
  }
  const scale = most > least ? (BINS - 1) / (most - least) : 0;
  const starts = new Uint32Array(BINS + 1);
  const bins = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    bins[i] = (most - depths[i]) * scale;
    starts[bins[i] + 1]++;
  }
  for (let bin = 0; bin < BINS; bin++) starts[bin + 1] += starts[bin];
  const order = new Uint32Array(WIDTH * Math.max(1, Math.ceil(count / WIDTH))); // whole rows of a texture
  for (let i = 0; i < count; i++) order[starts[bins[i]]++] = i;
  return order;
}
