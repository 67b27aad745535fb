// Charts over time on a canvas: bands, lines, dots and rules, with a cursor at the chosen time.
const charts = [];

function chart(box, spec) {
  const node = element("canvas", { "aria-label": spec.label, role: "img" });
  box.replaceChildren(node);
  const made = { node, spec, height: spec.height || 200 };
  node.style.height = `${made.height}px`;
  node.addEventListener("mousemove", (event) => hoverChart(made, event));
  node.addEventListener("mouseleave", hideTip);
  if (!spec.domain) node.addEventListener("click", (event) => change({ frame: nearestFrame(timeAt(made, event)), playing: false }));
  charts.push(made);
  drawChart(made);
  return made;
}

function dropCharts(container) {
  for (let i = charts.length - 1; i >= 0; i--) if (container.contains(charts[i].node)) charts.splice(i, 1);
}

function ticks(low, high, wanted) {
  const step = niceStep((high - low) / wanted);
  const out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(v);
  return [out, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

function axes(made) {
  const { spec, node, height } = made;
  const width = node.clientWidth || 300;
  const left = spec.left || 62;
  const [t0, t1] = spec.domain || [0, Math.max(scene.stamps[nFrames - 1] || 0, 1e-3)];
  const [y0, y1] = spec.range;
  const x = (t) => left + ((t - t0) / (t1 - t0)) * (width - left - 10);
  const y = (v) => height - 34 - ((v - y0) / (y1 - y0)) * (height - 44);
  return { width, height, left, t0, t1, y0, y1, x, y };
}

function timeAt(made, event) {
  const { left, width, t0, t1 } = axes(made);
  const share = (event.offsetX - left) / (width - left - 10);
  return t0 + Math.min(1, Math.max(0, share)) * (t1 - t0);
}

function drawChart(made) {
  const { node, spec } = made;
  const a = axes(made);
  const ratio = window.devicePixelRatio || 1;
  node.width = Math.round(a.width * ratio);
  node.height = Math.round(a.height * ratio);
  const g = node.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.font = "12px system-ui, sans-serif";
  drawAxes(g, a, spec);
  for (const layer of spec.layers) LAYERS[layer.kind](g, a, layer);
  if (state.frame !== null && !spec.domain) rule(g, a.x(scene.stamps[state.frame]), a.y(a.y0), a.y(a.y1), css("--accent"));
}

function drawAxes(g, a, spec) {
  Object.assign(g, { fillStyle: css("--soft"), strokeStyle: css("--faint"), lineWidth: 1, textAlign: "right", textBaseline: "middle" });
  const rows = spec.rows ? spec.rows.map((text, i) => [i, text]) : labelled(a.y0, a.y1, 4);
  for (const [v, text] of rows) {
    g.fillText(text, a.left - 7, a.y(v));
    g.beginPath();
    g.moveTo(a.left, a.y(v));
    g.lineTo(a.width - 10, a.y(v));
    g.stroke();
  }
  Object.assign(g, { textAlign: "center", textBaseline: "top" });
  for (const [t, text] of labelled(a.t0, a.t1, Math.max(2, Math.floor(a.width / 90)))) g.fillText(text, a.x(t), a.height - 30);
  g.textAlign = "right";
  g.fillText(spec.xlabel || "seconds", a.width - 10, a.height - 15);
  g.textAlign = "left";
  if (spec.unit) g.fillText(spec.unit, 2, a.height - 15);
}

function labelled(low, high, wanted) {
  const [values, decimals] = ticks(low, high, wanted);
  return values.map((v) => [v, v.toFixed(decimals)]);
}

function rule(g, x, y0, y1, colour) {
  g.beginPath();
  g.moveTo(x, y0);
  g.lineTo(x, y1);
  Object.assign(g, { strokeStyle: colour, lineWidth: 1.5 });
  g.stroke();
}

const clip = (a, v) => a.y(Math.min(a.y1, Math.max(a.y0, v)));

const LAYERS = {
  band(g, a, { t, low, high, gap }) {
    g.fillStyle = css("--band");
    for (let start = 0, end = 1; start < t.length; start = end++) {
      while (end < t.length && t[end] - t[end - 1] <= (gap || Infinity)) end++;
      g.beginPath();
      for (let i = start; i < end; i++) g.lineTo(a.x(t[i]), clip(a, high[i]));
      for (let i = end - 1; i >= start; i--) g.lineTo(a.x(t[i]), clip(a, low[i]));
      g.fill();
    }
  },
  line(g, a, { t, v, colour, gap, dash }) {
    g.setLineDash(dash || []);
    g.beginPath();
    for (let i = 0; i < t.length; i++) {
      if (i && t[i] - t[i - 1] > (gap || Infinity)) g.moveTo(a.x(t[i]), clip(a, v[i]));
      else g.lineTo(a.x(t[i]), clip(a, v[i]));
    }
    Object.assign(g, { strokeStyle: colour.startsWith("--") ? css(colour) : colour, lineWidth: 1.4 });
    g.stroke();
    g.setLineDash([]);
  },
  dots(g, a, { t, v, colour, size }) {
    g.fillStyle = colour.startsWith("--") ? css(colour) : colour;
    const r = size || 1.5;
    for (let i = 0; i < t.length; i++) g.fillRect(a.x(t[i]) - r, clip(a, v[i]) - r, 2 * r, 2 * r);
  },
  level(g, a, { v, text }) {
    g.setLineDash([4, 3]);
    g.beginPath();
    g.moveTo(a.left, a.y(v));
    g.lineTo(a.width - 10, a.y(v));
    Object.assign(g, { strokeStyle: css("--soft"), lineWidth: 1 });
    g.stroke();
    g.setLineDash([]);
    Object.assign(g, { fillStyle: css("--soft"), textAlign: "right", textBaseline: "bottom" });
    if (!text) return;
    Object.assign(g, { strokeStyle: css("--card"), lineWidth: 4, lineJoin: "round" });
    g.strokeText(text, a.width - 12, a.y(v) - 3);
    g.fillText(text, a.width - 12, a.y(v) - 3);
  },
};

function hoverChart(made, event) {
  const text = made.spec.read(timeAt(made, event), event.offsetY, axes(made));
  if (text) showTip(text, event.clientX, event.clientY);
  else hideTip();
}
