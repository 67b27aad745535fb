// The story of one cluster: its flowers, when each was seen, how it swayed, and what was decided.
const NEAR = (cluster) => Math.max(2 * cluster.size, 4 * cluster.sigma, 0.2 * median(scene.clusters.map((c) => c.size)));

function observationsOf(cluster) {
  const seen = scene.observations;
  const out = { accepted: [], rejected: [] };
  const limit = NEAR(cluster) * 1e4;
  for (let k = 0; k < seen.flower.length; k++) {
    if (seen.flower[k] !== NONE) {
      if (scene.flowers[seen.flower[k]].c === cluster.index) out.accepted.push(k);
    } else if (seen.near[k] === cluster.index && seen.distance[k] < limit) out.rejected.push(k);
  }
  return out;
}

function showDetail() {
  const box = byId("detail");
  dropCharts(box);
  box.hidden = state.cluster === null;
  if (box.hidden) return;
  const cluster = scene.clusters[state.cluster];
  const seen = observationsOf(cluster);
  const charts = [swayChart(cluster), sightings(cluster, seen), gateChart(cluster, seen)];
  const close = element("button", { type: "button", class: "quiet", onclick: () => change({ cluster: null }) }, "Close");
  const title = element("h2", {}, element("span", { class: "dot", colour: `var(${colourOf(cluster)})` }), `Cluster ${cluster.id}: ${plural(cluster.n, "flower")}`);
  const left = element("div", {}, ...charts.flatMap((c) => [element("p", { class: "chart-title" }, c.title), c.box]), closestCalls(seen));
  const right = element("div", {}, ...facts(cluster, seen), flowerTable(cluster), rejectedNear(seen));
  box.replaceChildren(element("div", { class: "bar" }, title, close), element("div", { class: "detail-grid" }, left, right));
  for (const c of charts) chart(c.box, c.spec);
}

function facts(cluster, seen) {
  const items = [
    `First seen at ${seconds(cluster.first)}, last at ${seconds(cluster.last)}, in ${plural(cluster.seen, "picture")}.`,
    `Its centre at rest is known to within ${length(cluster.r95)} (95 %; one standard deviation ${length(cluster.sigma)}).`,
    cluster.sway ? `It was seen up to ${length(cluster.sway)} away from its place at rest.` : "It was never seen away from its place at rest.",
    `${plural(seen.accepted.length, "detection")} accepted${cluster.inside === null ? "" : `; ${(100 * cluster.inside).toFixed(1)} % of them inside the 95 % gate`}.`,
    `${plural(seen.rejected.length, "detection")} rejected within ${length(NEAR(cluster))} of one of its flowers.`,
  ];
  if (cluster.merged.length) items.push(`Absorbed cluster ${cluster.merged.join(", ")}, which turned out to be the same.`);
  if (cluster.state !== "confirmed") items.push(`It is ${cluster.state}: not seen often enough to be sure.`);
  if (every > 1) items.push(`The session is long: of its pictures, one in ${every} is counted and drawn here.`);
  return [element("h3", {}, "In words"), element("ul", { class: "facts" }, ...items.map((text) => element("li", {}, text)))];
}

function flowerTable(cluster) {
  const sure = column(scene.flowers.map((f) => f.sigma));
  const head = ["Flower", "Seen", "Last at", `± ${sure.unit}`, "Misfit"];
  const rows = cluster.flowers.map((f) => [f.id, whole(f.seen), seconds(f.last), sure.text(f.sigma), f.misfit === null ? "–" : f.misfit.toFixed(2)]);
  return element("div", {}, element("h3", {}, "Flowers"), plainTable(head, rows));
}

function rejectedNear(seen) {
  const counts = new Map();
  for (const k of seen.rejected) counts.set(scene.observations.reason[k], (counts.get(scene.observations.reason[k]) || 0) + 1);
  const rows = [...counts].sort((a, b) => b[1] - a[1]).map(([reason, n]) => [data.reasons[reason].short, whole(n), data.reasons[reason].sentence]);
  return rows.length ? element("div", {}, element("h3", {}, "Rejected near it"), plainTable(["Reason", "Times", "Meaning"], rows, [0, 2])) : "";
}

// The accepted detections that fitted worst, and the rejected ones that were nearest.
function closestCalls(seen) {
  const { flower, reason, nis, distance } = scene.observations;
  const worst = seen.accepted.filter((k) => nis[k] !== NONE).sort((a, b) => nis[b] - nis[a]);
  const close = [...seen.rejected].sort((a, b) => distance[a] - distance[b]);
  const row = (k) =>
    flower[k] === NONE
      ? [seconds(scene.stamps[frameOf(k)]), "rejected", data.reasons[reason[k]].short, `${length(distance[k] / 1e4)} from its nearest flower`]
      : [seconds(scene.stamps[frameOf(k)]), `accepted as flower ${scene.flowers[flower[k]].id}`, "fits badly", `squared misfit ${(nis[k] / 100).toFixed(1)}`];
  const rows = [...worst.slice(0, 4), ...close.slice(0, 4)].sort((a, b) => a - b).map(row);
  return rows.length ? element("div", {}, element("h3", {}, "Closest calls"), plainTable(["Time", "Decision", "Why", "How far"], rows, [0, 1, 2])) : "";
}

function plainTable(head, rows, text = [0]) {
  const cell = (tag) => (value, i) => element(tag, { class: text.includes(i) ? "text" : null }, String(value));
  const table = element("table", { class: "plain" }, element("thead", {}, element("tr", {}, ...head.map(cell("th")))));
  table.append(element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map(cell("td"))))));
  return element("div", { class: "scroll-x" }, table);
}

function swayChart(cluster) {
  const rows = [...driftOf[cluster.index].values()];
  const t = rows.map((k) => scene.stamps[scene.drift.frame[k]]);
  const v = rows.map((k) => norm(displacement(k)));
  const [factor, unit] = unitOf(Math.max(...v, 1e-4));
  const scaled = v.map((x) => x * factor);
  const noise = rows.map((k) => scene.drift.sigma[k] * factor * Math.sqrt(7.8147));
  const top = Math.max(...scaled, ...noise, 1e-9) * 1.08;
  const read = (time) => {
    const i = nearest(t, time);
    return i < 0 ? null : `${seconds(t[i])}: ${length(v[i])} from rest (chance alone: up to ${length(noise[i] / factor)})`;
  };
  const steps = t.slice(1).map((time, i) => time - t[i]);
  const gap = Math.max(1, 5 * median(steps));
  const layers = [
    { kind: "band", t, low: noise.map(() => 0), high: noise, gap },
    { kind: "line", t, v: scaled, colour: colourOf(cluster), gap },
    { kind: "dots", t, v: scaled, colour: colourOf(cluster), size: 0.8 },
  ];
  return { title: `Sway: distance from its place at rest, ${unit} (shaded: what chance alone explains)`, box: element("div", { class: "chart" }), spec: { range: [0, top], layers, read, unit, label: "Sway over time" } };
}

function sightings(cluster, seen) {
  const names = cluster.flowers.map((f) => String(f.id));
  const index = new Map(cluster.flowers.map((f, i) => [scene.flowers.indexOf(f), i + 1]));
  const time = (k) => scene.stamps[frameOf(k)];
  const layers = [
    { kind: "dots", t: seen.accepted.map(time), v: seen.accepted.map((k) => index.get(scene.observations.flower[k])), colour: colourOf(cluster), size: 1.4 },
    { kind: "dots", t: seen.rejected.map(time), v: seen.rejected.map(() => 0), colour: "--bad", size: 1.8 },
  ];
  const rows = ["rejected", ...names];
  const read = (t, y, a) => {
    const i = rows.findIndex((_, i) => Math.abs(a.y(i) - y) < 9);
    return i < 0 ? null : i ? `${seconds(t)}: flower ${rows[i]}` : `${seconds(t)}: ${nearestReason(seen.rejected, t)}`;
  };
  const height = 54 + 17 * rows.length;
  return { title: "When each of its flowers was seen (each mark is one detection)", box: element("div", { class: "chart" }), spec: { range: [-0.5, rows.length - 0.5], rows, layers, read, height, left: 62, label: "Observations over time" } };
}

function nearestReason(rejected, t) {
  const i = nearest(rejected.map((k) => scene.stamps[frameOf(k)]), t);
  return i < 0 ? "nothing rejected" : data.reasons[scene.observations.reason[rejected[i]]].sentence;
}

function gateChart(cluster, seen) {
  const known = seen.accepted.filter((k) => scene.observations.nis[k] !== NONE);
  const t = known.map((k) => scene.stamps[frameOf(k)]);
  const v = known.map((k) => scene.observations.nis[k] / 100);
  const layers = [
    { kind: "dots", t, v, colour: colourOf(cluster), size: 1.2 },
    { kind: "level", v: 7.81, text: "95 % gate" },
  ];
  const read = (time) => (t.length ? `${seconds(t[nearest(t, time)])}: squared misfit ${v[nearest(t, time)].toFixed(1)}` : null);
  return { title: "How well each detection fitted (squared misfit; 5 % should lie above the line)", box: element("div", { class: "chart" }), spec: { range: [0, 20], layers, read, height: 150, label: "Misfit of detections over time" } };
}

function nearest(times, time) {
  let best = -1;
  for (let i = 0; i < times.length; i++) if (best < 0 || Math.abs(times[i] - time) < Math.abs(times[best] - time)) best = i;
  return best;
}
