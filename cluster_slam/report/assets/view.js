// A perspective view that orbits a target: three axes, projection of points and of covariances.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const minus = (a, b) => plus(a, b, -1);
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => a.map((v) => v / (norm(a) || 1));

class View {
  constructor(up) {
    this.up = up;
    this.east = unit(cross(up, Math.abs(up[2]) > 0.5 ? [0, 1, 0] : [0, 0, 1])).map((v) => -v);
    this.north = cross(this.up, this.east);
    Object.assign(this, { yaw: 0.6, pitch: 0.35, distance: 1, target: [0, 0, 0], width: 1, height: 1 });
  }

  update(width, height) {
    Object.assign(this, { width, height });
    const flat = plus(this.east.map((v) => v * Math.cos(this.yaw)), this.north, Math.sin(this.yaw));
    const back = plus(flat.map((v) => v * Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
    this.eye = plus(this.target, back, this.distance);
    this.forward = back.map((v) => -v);
    this.right = unit(cross(this.forward, this.up));
    this.above = cross(this.right, this.forward);
    this.focal = 1.35 * Math.min(width, height);
  }

  // [x, y, pixels per metre, depth]; null behind the eye.
  project(p) {
    const v = minus(p, this.eye);
    const depth = dot(v, this.forward);
    if (depth < 0.02 * this.distance) return null;
    const s = this.focal / depth;
    return [this.width / 2 + s * dot(v, this.right), this.height / 2 - s * dot(v, this.above), s, depth];
  }

  // Outline of the ellipsoid of a covariance: half-axes in metres (one sigma) and the angle of the first on screen.
  outline(c) {
    const times = (a) => [c[0] * a[0] + c[1] * a[1] + c[2] * a[2], c[1] * a[0] + c[3] * a[1] + c[4] * a[2], c[2] * a[0] + c[4] * a[1] + c[5] * a[2]];
    const r = times(this.right);
    const xx = dot(this.right, r);
    const xy = -dot(this.above, r);
    const yy = dot(this.above, times(this.above));
    const half = (xx + yy) / 2;
    const root = Math.hypot((xx - yy) / 2, xy);
    return [Math.sqrt(Math.max(half + root, 0)), Math.sqrt(Math.max(half - root, 0)), 0.5 * Math.atan2(2 * xy, xx - yy)];
  }

  // Look at points so that they fill the picture from where the view stands.
  fit(points) {
    this.enclose(points);
    for (let i = 0; i < 4; i++) {
      this.update(this.width, this.height);
      const shown = points.map((p) => this.project(p)).filter(Boolean);
      const [x, y] = [0, 1].map((k) => [Math.min(...shown.map((q) => q[k])), Math.max(...shown.map((q) => q[k]))]);
      this.pan(this.width / 2 - (x[0] + x[1]) / 2, this.height / 2 - (y[0] + y[1]) / 2);
      const filled = Math.max((x[1] - x[0]) / (this.width - 60), (y[1] - y[0]) / (this.height - 60), 0.05);
      this.distance *= Math.min(1.5, Math.max(0.6, filled));
    }
  }

  enclose(points) {
    const low = [0, 1, 2].map((i) => Math.min(...points.map((p) => p[i])));
    const high = [0, 1, 2].map((i) => Math.max(...points.map((p) => p[i])));
    this.target = low.map((v, i) => (v + high[i]) / 2);
    let radius = 0;
    for (const p of points) radius = Math.max(radius, norm(minus(p, this.target)));
    this.reach = Math.max(radius, 1e-3);
    this.distance = this.reach * 2.6;
  }

  pan(dx, dy) {
    const s = this.distance / this.focal;
    this.target = plus(plus(this.target, this.right, -dx * s), this.above, dy * s);
  }
}
