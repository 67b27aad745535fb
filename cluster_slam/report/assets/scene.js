// The plant in 3-D on a canvas: an ellipsoid seen from outside is an ellipse, so no mesh is needed.
const CHI95 = Math.sqrt(7.8147); // half-axes of the 95 % ellipsoid, in sigmas
const canvas = byId("scene");
const pen = canvas.getContext("2d");
const view = new View(scene.up);
const row = (array, k) => [array[3 * k], array[3 * k + 1], array[3 * k + 2]];

function paint() {
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  view.update(width, height);
  paintFloor();
  paintPath();
  for (const [, draw] of landmarks().sort((a, b) => b[0] - a[0])) draw();
  if (state.showRejected) paintRejected();
  if (state.frame !== null) paintFrame(state.frame);
  paintLabels();
}

function line(points, colour, width, dash = []) {
  pen.beginPath();
  let started = false;
  for (const p of points) {
    const q = p && view.project(p);
    if (!q) started = false;
    else if (started) pen.lineTo(q[0], q[1]);
    else pen.moveTo(q[0], q[1]);
    if (q) started = true;
  }
  pen.setLineDash(dash);
  Object.assign(pen, { strokeStyle: colour, lineWidth: width });
  pen.stroke();
  pen.setLineDash([]);
}

function niceStep(size) {
  const power = 10 ** Math.floor(Math.log10(size));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= size * 0.999);
}

let floorStep = 0;
function paintFloor() {
  const points = [...scene.flowers.map((f) => f.p), ...(view.scope === "all" ? sparsePath : [])];
  if (!points.length) return;
  const along = (axis) => points.map((p) => dot(p, axis));
  const range = (values) => [Math.min(...values), Math.max(...values)];
  const [x, y, z] = [view.east, view.north, view.up].map((axis) => range(along(axis)));
  floorStep = niceStep(Math.max(x[1] - x[0], y[1] - y[0], 1e-3) / 6);
  const floor = z[0] - 0.35 * floorStep;
  const corner = (a, b) => plus(plus(view.east.map((v) => v * a), view.north, b), view.up, floor);
  const low = [x, y].map(([v]) => Math.floor(v / floorStep - 0.5) * floorStep);
  const high = [x, y].map(([, v]) => Math.ceil(v / floorStep + 0.5) * floorStep);
  const faint = css("--line");
  for (let a = low[0]; a <= high[0] + 1e-9; a += floorStep) line([corner(a, low[1]), corner(a, high[1])], faint, 0.6);
  for (let b = low[1]; b <= high[1] + 1e-9; b += floorStep) line([corner(low[0], b), corner(high[0], b)], faint, 0.6);
}

const stride = Math.max(1, Math.floor(nFrames / 60));
const sparsePath = [];
for (let k = 0; k < nFrames; k += stride) sparsePath.push(row(scene.after, k));

// The path as given is drawn off the estimated one by the magnified difference.
function givenPoint(k) {
  const after = row(scene.after, k);
  return plus(after, minus(row(scene.before, k), after), pathFactor());
}

function pathFactor() {
  return state.magnifyPath ? state.magnify : 1;
}

function paintPath() {
  const step = Math.max(1, Math.floor(nFrames / 4000));
  const frames = [];
  for (let k = 0; k < nFrames; k += step) frames.push(k);
  line(frames.map(givenPoint), css("--reject"), 1, [3, 3]);
  line(frames.map((k) => row(scene.after, k)), css("--ink"), 1.6);
  if (state.frame === null && nFrames) for (const p of [row(scene.after, 0)]) mark(p, css("--ink"), 3);
}

function mark(p, colour, radius) {
  const q = view.project(p);
  if (!q) return;
  pen.beginPath();
  pen.arc(q[0], q[1], radius, 0, 7);
  pen.fillStyle = colour;
  pen.fill();
}

function ellipsoid(p, cov, colour, strong) {
  const q = view.project(p);
  if (!q) return;
  const [a, b, angle] = view.outline(cov);
  const s = q[2] * CHI95 * state.magnify;
  pen.beginPath();
  pen.ellipse(q[0], q[1], Math.max(a * s, 0.5), Math.max(b * s, 0.5), angle, 0, 7);
  pen.fillStyle = colour;
  pen.globalAlpha = strong ? 0.28 : 0.12;
  pen.fill();
  pen.globalAlpha = strong ? 1 : 0.55;
  Object.assign(pen, { strokeStyle: colour, lineWidth: strong ? 1.6 : 0.8 });
  pen.stroke();
  pen.globalAlpha = 1;
}

function landmarks() {
  const out = [];
  const add = (p, draw) => {
    const q = view.project(p);
    if (q) out.push([q[3], draw]);
  };
  const chosen = state.cluster;
  for (const flower of scene.flowers) {
    const cluster = scene.clusters[flower.c];
    const faded = chosen !== null && chosen !== flower.c;
    const colour = css(colourOf(cluster));
    add(flower.p, () => {
      pen.globalAlpha = faded ? 0.35 : 1;
      if (cluster.n > 1) line([cluster.p, flower.p], colour, chosen === flower.c ? 1.5 : 0.9);
      mark(flower.p, colour, chosen === flower.c ? 3.6 : 2.6);
      pen.globalAlpha = 1;
      if (!faded || state.magnify > 1) ellipsoid(flower.p, flower.cov, colour, false);
    });
  }
  for (const cluster of scene.clusters) {
    if (cluster.n === 1) continue;
    add(cluster.p, () => ellipsoid(cluster.p, cluster.cov, css(colourOf(cluster)), chosen === cluster.index || chosen === null));
  }
  return out;
}

function paintLabels() {
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  const crowded = scene.clusters.length > 60;
  const allSingle = scene.clusters.every((c) => c.n === 1);
  for (const cluster of scene.clusters) {
    const chosen = state.cluster === cluster.index;
    if ((crowded || (cluster.n === 1 && !allSingle)) && !chosen && state.hover !== cluster.index) continue;
    const q = view.project(cluster.p);
    if (!q) continue;
    const y = q[1] - 9;
    Object.assign(pen, { lineWidth: 3.5, strokeStyle: css("--paper"), fillStyle: css("--ink"), lineJoin: "round" });
    pen.strokeText(cluster.id, q[0], y);
    pen.fillText(cluster.id, q[0], y);
    if (chosen) {
      pen.beginPath();
      pen.arc(q[0], q[1], Math.max(16, cluster.size * q[2] * 1.25), 0, 7);
      Object.assign(pen, { strokeStyle: css("--accent"), lineWidth: 2 });
      pen.stroke();
    }
  }
}

function paintFrame(frame) {
  const seen = scene.observations;
  const eye = row(scene.after, frame);
  paintCamera(frame, eye);
  for (let k = seen.first[frame]; k < seen.first[frame + 1]; k++) {
    const p = pointOf(k);
    const q = p && view.project(p);
    if (!q) continue;
    const known = seen.flower[k] !== NONE;
    if (known) {
      const colour = css(colourOf(scene.clusters[scene.flowers[seen.flower[k]].c]));
      line([eye, p], colour, 0.35);
      mark(p, colour, 4);
      pen.beginPath();
      pen.arc(q[0], q[1], 4.5, 0, 7);
      Object.assign(pen, { strokeStyle: css("--paper"), lineWidth: 1.2 });
      pen.stroke();
    } else crossMark(q, css("--bad"));
  }
  for (const cluster of scene.clusters) {
    const k = driftOf[cluster.index].get(frame);
    if (k === undefined) continue;
    const now = plus(cluster.p, displacement(k));
    line([cluster.p, now], css("--ink"), 2);
    const q = view.project(now);
    if (!q) continue;
    pen.beginPath();
    pen.arc(q[0], q[1], 6, 0, 7);
    Object.assign(pen, { strokeStyle: css("--ink"), lineWidth: 1.4 });
    pen.stroke();
  }
}

function paintRejected() {
  const seen = scene.observations;
  const total = seen.flower.length;
  const step = Math.max(1, Math.floor(total / 60000));
  pen.fillStyle = css("--bad");
  pen.globalAlpha = 0.6;
  for (let k = 0; k < total; k += step) {
    const q = seen.flower[k] === NONE && pointOf(k) && view.project(pointOf(k));
    if (q) pen.fillRect(q[0] - 1, q[1] - 1, 2, 2);
  }
  pen.globalAlpha = 1;
}

function crossMark(q, colour) {
  pen.beginPath();
  for (const [a, b] of [[-4, -4], [-4, 4]]) {
    pen.moveTo(q[0] + a, q[1] + b);
    pen.lineTo(q[0] - a, q[1] - b);
  }
  Object.assign(pen, { strokeStyle: colour, lineWidth: 1.8 });
  pen.stroke();
}

function paintCamera(frame, eye) {
  const [x, y, z, w] = scene.orientation.subarray(4 * frame, 4 * frame + 4);
  const turn = (v) => {
    const t = cross([x, y, z], v).map((c) => 2 * c);
    return plus(plus(v, t, w), cross([x, y, z], t));
  };
  const size = 0.07 * view.distance;
  const corners = [[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]].map((v) => plus(eye, turn(v), size));
  for (const corner of corners) line([eye, corner], css("--ink"), 1.4);
  line([...corners, corners[0]], css("--ink"), 1.4);
}
