// The live replay: plays what was known at each instant. Stands alone; colours are the page's.
(() => {
  const byId = (id) => document.getElementById(id);
  const TYPES = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, f4: Float32Array };
  const d = JSON.parse(byId("replay-data").textContent);
  for (const [name, packed] of Object.entries(d)) {
    if (!packed.b && packed.b !== "") continue;
    const bytes = Uint8Array.from(atob(packed.b), (c) => c.charCodeAt(0));
    d[name] = new TYPES[packed.t](bytes.buffer);
  }
  const canvas = byId("replay-canvas");
  const slider = byId("replay-slider");
  const n = d.t.length;
  slider.max = String(n - 1);
  const TRAIL_S = 2;
  const RADIUS = Math.sqrt(5.991); // 95 %, two degrees of freedom
  let now = 0;
  let timer = 0;

  // Where each cluster mostly was: sway is drawn larger about it.
  const quantile = (values, q) => values.sort((x, y) => x - y)[Math.floor(q * (values.length - 1))];
  const rest = d.ids.map((_, c) => [0, 1].map((axis) => {
    const mine = [];
    for (let k = 0; k < d.cluster.length; k++) if (d.cluster[k] === c) mine.push(d.p[2 * k + axis]);
    return quantile(mine, 0.5);
  }));
  const low = [0, 1].map((axis) => Math.min(...rest.map((r) => r[axis])));
  const high = [0, 1].map((axis) => Math.max(...rest.map((r) => r[axis])));
  const magnify = () => Number(byId("replay-magnify").value);

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const style = (what) => ((what & 3) === 2 ? colour("--bad") : what & 4 ? colour("--c1") : colour("--good"));

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio);
    g.clearRect(0, 0, width, height);
    const room = [0, 1].map((axis) => Math.max(1.3 * (high[axis] - low[axis]), 0.1));
    const scale = Math.min(width / room[0], height / room[1]);
    const place = (x, y) => [
      width / 2 + (x - (low[0] + high[0]) / 2) * scale,
      height / 2 - (y - (low[1] + high[1]) / 2) * scale,
    ];
    const times = magnify();
    const at = (k) => {
      const [x, y] = rest[d.cluster[k]];
      return place(x + times * (d.p[2 * k] - x), y + times * (d.p[2 * k + 1] - y));
    };
    trails(g, at);
    let tracked = 0;
    let lost = 0;
    for (let k = d.first[now]; k < d.first[now + 1]; k++) {
      cluster(g, k, at(k), times * scale);
      if ((d.what[k] & 3) === 2) lost++;
      else tracked++;
    }
    const [cx, cy] = place(d.camera[2 * now], d.camera[2 * now + 1]);
    g.strokeStyle = colour("--accent");
    g.strokeRect(cx - 6, cy - 4, 12, 8);
    byId("replay-clock").textContent = `${d.t[now].toFixed(1)} s`;
    byId("replay-words").textContent = `${tracked} tracked, ${lost} lost`;
    slider.value = String(now);
  }

  function trails(g, at) {
    const last = new Map();
    let first = now;
    while (first > 0 && d.t[now] - d.t[first - 1] <= TRAIL_S) first--;
    g.lineWidth = 1.5;
    for (let k = d.first[first]; k < d.first[now + 1]; k++) {
      if (!(d.what[k] & 8)) continue;
      const before = last.get(d.cluster[k]);
      const here = at(k);
      if (before) {
        g.strokeStyle = style(d.what[k]);
        g.globalAlpha = 0.5;
        g.beginPath();
        g.moveTo(...before);
        g.lineTo(...here);
        g.stroke();
      }
      last.set(d.cluster[k], here);
    }
    g.globalAlpha = 1;
  }

  function cluster(g, k, [x, y], scale) {
    const [a, b, c] = [d.cov[3 * k], d.cov[3 * k + 1], d.cov[3 * k + 2]];
    const middle = (a + c) / 2;
    const spread = Math.hypot((a - c) / 2, b);
    const long = Math.max(RADIUS * Math.sqrt(middle + spread) * scale, 3);
    const short = Math.max(RADIUS * Math.sqrt(Math.max(middle - spread, 0)) * scale, 3);
    g.strokeStyle = g.fillStyle = style(d.what[k]);
    g.lineWidth = 1.5;
    g.beginPath();
    g.ellipse(x, y, long, short, -0.5 * Math.atan2(2 * b, a - c), 0, 2 * Math.PI);
    g.globalAlpha = 0.15;
    g.fill();
    g.globalAlpha = 1;
    g.stroke();
    g.beginPath();
    g.arc(x, y, 2.5, 0, 2 * Math.PI);
    if (d.what[k] & 8) g.fill();
    else g.stroke();
    g.font = "12px system-ui, sans-serif";
    g.fillText(String(d.ids[d.cluster[k]]), x + long + 3, y - 3);
  }

  function step() {
    if (now + 1 >= n) return stop();
    const wait = Math.min(Math.max(d.t[now + 1] - d.t[now], 0.02), 1);
    now++;
    draw();
    timer = setTimeout(step, 1000 * wait);
  }

  function stop() {
    clearTimeout(timer);
    timer = 0;
    byId("replay-play").textContent = "Play";
    byId("replay-play").setAttribute("aria-pressed", "false");
  }

  byId("replay-play").addEventListener("click", () => {
    if (timer) return stop();
    if (now + 1 >= n) now = 0;
    byId("replay-play").textContent = "Pause";
    byId("replay-play").setAttribute("aria-pressed", "true");
    timer = setTimeout(step, 0);
  });
  slider.addEventListener("input", () => {
    stop();
    now = Number(slider.value);
    draw();
  });
  byId("replay-magnify").addEventListener("change", draw);
  window.addEventListener("resize", draw);
  draw();
})();
