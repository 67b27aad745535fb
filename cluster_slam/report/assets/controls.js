// Slider, play, magnification, theme, and the pointer in the 3-D view.
const slider = byId("slider");
const STEPS = [1, 2, 5, 10, 20, 50, 100, 200, 500];

function chooseMagnify() {
  const radius = median(scene.clusters.map((c) => c.r95)) || median(scene.flowers.map((f) => CHI95 * f.sigma));
  const spread = view.reach;
  const wanted = radius ? (0.03 * spread) / radius : 1;
  const best = STEPS.filter((s) => s <= wanted).pop() || 1;
  byId("magnify").replaceChildren(...STEPS.map((s) => element("option", { value: s }, s === 1 ? "true size" : `${s} times`)));
  byId("magnify").value = best;
  change({ magnify: best });
}

function fitView(scope) {
  view.scope = scope === "all" ? "all" : "plant";
  const cluster = scene.clusters[state.cluster];
  const plant = scene.flowers.map((f) => f.p);
  const chosen = scope === "cluster" && cluster ? cluster.flowers.map((f) => f.p) : scope === "plant" ? plant : [...plant, ...sparsePath];
  if (!chosen.length) return;
  view.update(canvas.clientWidth, canvas.clientHeight);
  view.fit(chosen);
  if (scope === "cluster" && cluster && cluster.n === 1) view.distance = 0.3 * norm(minus(plant[0], sparsePath[0] || [0, 0, 0])) || 0.3;
  paint();
}

function lookFromCamera() {
  const centre = (points) => points.reduce((sum, p) => plus(sum, p, 1 / points.length), [0, 0, 0]);
  if (!scene.flowers.length || !sparsePath.length) return;
  const d = minus(centre(sparsePath), centre(scene.flowers.map((f) => f.p)));
  view.yaw = Math.atan2(dot(d, view.north), dot(d, view.east)) + 0.55;
}

function frameWords(frame) {
  const seen = scene.observations;
  const reasons = new Map();
  const clusters = new Set();
  let flowers = 0;
  for (let k = seen.first[frame]; k < seen.first[frame + 1]; k++) {
    if (seen.flower[k] === NONE) reasons.set(seen.reason[k], (reasons.get(seen.reason[k]) || 0) + 1);
    else {
      flowers++;
      clusters.add(scene.flowers[seen.flower[k]].c);
    }
  }
  const away = scene.clusters.filter((c) => driftOf[c.index].has(frame)).map((c) => [norm(displacement(driftOf[c.index].get(frame))), c]);
  const [most, who] = away.sort((a, b) => b[0] - a[0])[0] || [0, null];
  const rejected = [...reasons].map(([reason, n]) => `${n} ${data.reasons[reason].short}`).join(", ");
  const total = [...reasons.values()].reduce((a, b) => a + b, 0);
  return `The camera sees ${plural(flowers, "flower")} of ${plural(clusters.size, "cluster")}; ${total ? `${total} rejected (${rejected})` : "nothing rejected"}.${who ? ` Farthest from rest: cluster ${who.id}, ${length(most)}.` : ""}`;
}

function showTime() {
  const frame = state.frame;
  byId("whole").disabled = frame === null;
  byId("play").textContent = state.playing ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", String(state.playing));
  if (frame === null) {
    byId("clock").textContent = `0 to ${seconds(scene.stamps[nFrames - 1] || 0)}`;
    byId("now").textContent = "Move the slider to see where each cluster was and what the camera saw at that moment.";
    return;
  }
  slider.value = frame;
  const t = scene.stamps[frame];
  byId("clock").textContent = [seconds(t), clockTime(scene.start + t)].filter(Boolean).join(" · ");
  byId("now").textContent = frameWords(frame);
}

function play(before) {
  if (!state.playing) return;
  const now = performance.now();
  const passed = before === undefined ? 0 : (now - before) / 1000;
  const speed = Math.max(1, (scene.stamps[nFrames - 1] || 1) / 60);
  const at = scene.stamps[state.frame ?? 0] + passed * speed;
  let frame = state.frame ?? 0;
  while (frame + every < nFrames && scene.stamps[frame + every] <= at) frame += every;
  if (frame + every >= nFrames) change({ frame, playing: false });
  else if (frame !== state.frame) change({ frame });
  const next = frame === state.lastPlayed ? before : now;
  state.lastPlayed = frame;
  requestAnimationFrame(() => play(next ?? now));
}

function clusterAt(x, y) {
  let best = null;
  const consider = (p, index, bonus) => {
    const q = view.project(p);
    const d = q ? Math.hypot(q[0] - x, q[1] - y) - bonus : Infinity;
    if (d < 12 && (!best || d < best[0])) best = [d, index];
  };
  for (const flower of scene.flowers) consider(flower.p, flower.c, 0);
  for (const cluster of scene.clusters) consider(cluster.p, cluster.index, 3);
  return best ? best[1] : null;
}

function pointer() {
  const held = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
    canvas.setPointerCapture(event.pointerId);
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return hover(event);
    const [dx, dy] = [event.offsetX - last[0], event.offsetY - last[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    if (held.size === 2) pinch(held, event);
    else if (event.shiftKey || event.buttons === 2) view.pan(dx, dy);
    else Object.assign(view, { yaw: view.yaw - 0.008 * dx, pitch: Math.max(-1.5, Math.min(1.5, view.pitch + 0.008 * dy)) });
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
    paint();
  });
  canvas.addEventListener("pointerup", (event) => {
    held.delete(event.pointerId);
    if (moved < 5 && event.button === 0) change({ cluster: clusterAt(event.offsetX, event.offsetY) });
  });
  canvas.addEventListener("pointercancel", (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointerleave", () => hoverCluster(null));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.distance *= Math.exp(0.0012 * event.deltaY);
    paint();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (turn) {
      event.preventDefault();
      view.yaw += turn[0];
      view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + turn[1]));
    } else if (event.key === "+" || event.key === "-") view.distance *= event.key === "+" ? 0.9 : 1.1;
    paint();
  });
}

function pinch(held, event) {
  const other = [...held].find(([id]) => id !== event.pointerId)[1];
  const before = held.get(event.pointerId);
  const distance = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
  view.distance *= distance(before) / distance([event.offsetX, event.offsetY]);
}

function hover(event) {
  const index = clusterAt(event.offsetX, event.offsetY);
  hoverCluster(index);
  if (index === null) return;
  const cluster = scene.clusters[index];
  const tip = byId("scene-tip");
  tip.textContent = `Cluster ${cluster.id}: ${plural(cluster.n, "flower")}\nsure to ${length(cluster.r95)} (95 %)\nseen in ${plural(cluster.seen, "picture")}`;
  tip.style.left = `${Math.min(event.offsetX + 14, canvas.clientWidth - 190)}px`;
  tip.style.top = `${Math.max(4, event.offsetY - 70)}px`;
}

function hoverCluster(index) {
  byId("scene-tip").hidden = index === null;
  if (state.hover === index) return;
  state.hover = index;
  paint();
}

function legend() {
  const [ink, blue] = [css("--ink"), css("--c0")];
  const mark = (inner) => `<svg viewBox="0 0 22 12" aria-hidden="true">${inner}</svg>`;
  const path = pathFactor() > 1 ? `, ${state.magnify} times farther from the solid line` : "";
  const items = [
    [mark(`<circle cx="11" cy="6" r="3" fill="${blue}"/>`), "flower at rest"],
    [mark(`<ellipse cx="11" cy="6" rx="9" ry="5" fill="${blue}33" stroke="${blue}"/>`), `95 % ellipsoid${state.magnify > 1 ? `, ${state.magnify} times its size` : ""}`],
    [mark(`<path d="M0 6H22" stroke="${ink}" stroke-width="2"/>`), "camera path, corrected"],
    [mark(`<path d="M0 6H22" stroke="${css("--reject")}" stroke-dasharray="3 3" stroke-width="1.5"/>`), `camera path as given${path}`],
    ["", `grid ${length(floorStep)}`],
  ];
  if (state.showRejected) items.push([mark(`<rect x="9" y="4" width="3" height="3" fill="${css("--bad")}"/>`), "rejected detections"]);
  if (state.frame !== null) {
    items.push([mark(`<circle cx="11" cy="6" r="5" fill="none" stroke="${ink}"/>`), "where a cluster is at this moment"]);
    items.push([mark(`<path d="M7 2l8 8M7 10l8-8" stroke="${css("--bad")}" stroke-width="2"/>`), "rejected detection"]);
  }
  const nodes = items.map(([svg, text]) => {
    const li = element("li");
    li.innerHTML = svg;
    li.append(text);
    return li;
  });
  byId("legend").replaceChildren(...nodes);
}
