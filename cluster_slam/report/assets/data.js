// The page's data, with packed arrays turned into typed arrays.
const TYPES = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i2: Int16Array, f4: Float32Array };
const NONE = 65535;
const OUTSIDE = -32768;

function unpack(packed) {
  const text = atob(packed.b);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new TYPES[packed.t](bytes.buffer);
}

function unpackAll(node) {
  if (Array.isArray(node)) return node.map(unpackAll);
  if (node === null || typeof node !== "object") return node;
  if ("b" in node && "t" in node && "s" in node) return unpack(node);
  return Object.fromEntries(Object.entries(node).map(([key, value]) => [key, unpackAll(value)]));
}

const data = unpackAll(JSON.parse(byId("data").textContent));
const scene = data.scene;
const nFrames = scene.stamps.length;
const colourOf = (cluster) => `--c${cluster.colour}`;

scene.clusters.forEach((cluster, index) => {
  cluster.index = index;
  cluster.flowers = scene.flowers.filter((flower) => flower.c === index);
});

// Rows of the drift table of each cluster, by frame.
const driftOf = scene.clusters.map(() => new Map());
for (let k = 0; k < scene.drift.frame.length; k++) driftOf[scene.drift.cluster[k]].set(scene.drift.frame[k], k);

function displacement(k) {
  const { d, step } = scene.drift;
  return [d[3 * k] * step, d[3 * k + 1] * step, d[3 * k + 2] * step];
}

function pointOf(k) {
  const p = scene.observations.p;
  if (p[3 * k] === OUTSIDE) return null;
  return [0, 1, 2].map((i) => scene.box.centre[i] + p[3 * k + i] * scene.box.step);
}

function frameOf(k) {
  let low = 0;
  let high = nFrames;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (scene.observations.first[middle] <= k) low = middle;
    else high = middle;
  }
  return low;
}

const { every } = scene.observations; // of a long session only each so manieth frame is in the page

function nearestFrame(time) {
  let best = 0;
  for (let k = every; k < nFrames; k += every) if (Math.abs(scene.stamps[k] - time) < Math.abs(scene.stamps[best] - time)) best = k;
  return best;
}
