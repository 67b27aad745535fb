"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const hue = (id) => colour("--c" + (id % 6));
  const state = { plant: 0, day: 0, chosen: null, yaw: 0.5, tilt: 0.3, zoom: 1 };

  const plant = () => data.plants[state.plant];
  const cell = (tag, text) => { const e = document.createElement(tag); e.textContent = text; return e; };

  function lastSeen(life, day) {
    for (let k = day; k >= 0; k--) if (life[k] && life[k] !== 0) return { where: life[k], k };
    return null;
  }

  function canvas(id) {
    const c = at(id), ratio = window.devicePixelRatio || 1, width = c.clientWidth, height = +c.getAttribute("height");
    if (!c.dataset.height) c.dataset.height = String(height);
    const h = +c.dataset.height;
    c.width = width * ratio; c.height = h * ratio; c.style.height = h + "px";
    const g = c.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, h);
    return { g, width, height: h };
  }

  function frame(points) {
    const centre = [0, 1, 2].map((k) => points.reduce((s, p) => s + p[k], 0) / Math.max(points.length, 1));
    const half = Math.max(0.05, ...points.map((p) => Math.hypot(p[0] - centre[0], p[1] - centre[1], p[2] - centre[2])));
    return { centre, half };
  }

  function project(p, box, view) {
    const x = p[0] - box.centre[0], y = p[1] - box.centre[1], z = p[2] - box.centre[2];
    const cy = Math.cos(state.yaw), sy = Math.sin(state.yaw), ct = Math.cos(state.tilt), st = Math.sin(state.tilt);
    const a = cy * x + sy * y, b = -sy * x + cy * y, s = (0.45 * Math.min(view.width, view.height * 1.6) / box.half) * state.zoom;
    return [view.width / 2 + s * a, view.height / 2 - s * (ct * z - st * b), ct * b + st * z];
  }

  function drawScene() {
    const view = canvas("scene"), g = view.g, p = plant();
    const all = p.sessions.flatMap((s) => s.after);
    const box = frame(all.length ? all : [[0, 0, 0]]);
    const drawn = [];
    for (const f of p.flowers) {
      const seen = lastSeen(f.life, state.day);
      if (!seen) continue;
      const q = project(seen.where, box, view);
      drawn.push({ depth: q[2], draw: () => {
        g.beginPath(); g.arc(q[0], q[1], 3, 0, 7);
        if (seen.k === state.day) { g.fillStyle = hue(f.cluster); g.fill(); } else { g.strokeStyle = hue(f.cluster); g.stroke(); }
      } });
    }
    for (const c of p.clusters) {
      const seen = lastSeen(c.life, state.day);
      if (!seen) continue;
      const q = project(seen.where, box, view), r = 6 + 2 * seen.where[3];
      const tip = project(seen.where.slice(0, 3).map((v, k) => v + c.velocity[k] / 100), box, view);
      drawn.push({ depth: q[2] + 0.01, draw: () => {
        g.beginPath(); g.arc(q[0], q[1], r, 0, 7); g.strokeStyle = hue(c.id); g.lineWidth = state.chosen === c.id ? 3 : 1.2;
        if (seen.k === state.day) { g.globalAlpha = 0.25; g.fillStyle = hue(c.id); g.fill(); g.globalAlpha = 1; } else g.setLineDash([3, 3]);
        g.stroke(); g.setLineDash([]); g.lineWidth = 1.5;
        g.beginPath(); g.moveTo(q[0], q[1]); g.lineTo(tip[0], tip[1]); g.stroke(); g.lineWidth = 1;
        g.fillStyle = colour("--ink"); g.font = "11px sans-serif"; g.fillText(String(c.id), q[0] + r + 2, q[1] - 2);
      } });
    }
    drawn.sort((a, b) => b.depth - a.depth).forEach((d) => d.draw());
  }

  function drawPoints(id, sets, title) {
    const view = canvas(id), g = view.g, box = frame(sets.flatMap((s) => s.points));
    for (const s of sets) {
      g.strokeStyle = g.fillStyle = colour(s.colour);
      for (const p of s.points) {
        const q = project(p, box, view);
        g.beginPath(); g.arc(q[0], q[1], 4, 0, 7);
        if (s.filled) g.fill(); else g.stroke();
      }
    }
    g.fillStyle = colour("--soft"); g.font = "12px sans-serif"; g.fillText(title, 6, 14);
  }

  function drawAlignment() {
    const p = plant(), s = p.sessions[state.day], map = [];
    if (!s) return;
    for (const c of p.clusters) { const seen = lastSeen(c.life, state.day - 1); if (seen) map.push(seen.where.slice(0, 3)); }
    at("alignment").textContent = map.length
      ? `${s.id}: sure to ${s.probability.toFixed(4)}; one sigma ${s.turn_deg} degrees, ${s.shift_mm} mm at the plant's middle` + (s.scale !== 1 ? `; scale ${s.scale}` : "")
      : "The first session makes the frame.";
    drawPoints("before", [{ points: map, colour: "--soft", filled: false }, { points: s.before, colour: "--c1", filled: true }], "before: as the base stood");
    drawPoints("after", [{ points: map, colour: "--soft", filled: false }, { points: s.after, colour: "--c0", filled: true }], "after: in the map (rings: where it was last)");
  }

  function mark(entry) {
    if (entry === null || entry === undefined) return "";
    if (entry === 0) return "✕";
    return entry.length > 3 ? (entry[5] ? "○ " : "● ") + entry[3] : "●";
  }

  function row(head, life, tail, onclick, chosen) {
    const tr = document.createElement("tr");
    tr.append(cell("th", head), ...life.map((e) => cell("td", mark(e))), cell("td", tail));
    if (onclick) { tr.tabIndex = 0; tr.onclick = onclick; tr.onkeydown = (e) => { if (e.key === "Enter") onclick(); }; }
    if (chosen) tr.className = "chosen";
    return tr;
  }

  function drawLives() {
    const p = plant(), table = at("lives"), head = document.createElement("tr");
    head.append(cell("th", "cluster"), ...p.sessions.map((s) => cell("th", s.date.slice(0, 10) || "no date")), cell("th", "now"));
    const rows = [head];
    for (const c of p.clusters) {
      const done = c.events.length ? `, ${c.events.map((e) => e.kind).join(", ")}` : "";
      rows.push(row(String(c.id), c.life, `${c.state} (${c.presence})${done}`, () => { state.chosen = state.chosen === c.id ? null : c.id; draw(); }, state.chosen === c.id));
      if (state.chosen === c.id) for (const f of p.flowers) if (f.cluster === c.id) rows.push(row(`  flower ${f.id}`, f.life, `${f.presence}`));
    }
    table.replaceChildren(...rows);
  }

  function drawChosen() {
    const c = plant().clusters.find((x) => x.id === state.chosen), box = at("chosen");
    if (!c) { box.textContent = "none: choose a row above"; return; }
    const speed = Math.hypot(...c.velocity).toFixed(2);
    const lines = [`Cluster ${c.id}: ${c.n_flowers} flowers there, ${c.state} with probability ${c.presence}; drifts ${speed} mm a day; position to ${c.sigma_mm} mm (one sigma) when last seen.`];
    for (const e of c.events) lines.push(`${e.date}: ${e.kind}${e.note ? ", " + e.note : ""}`);
    box.replaceChildren(...lines.map((t) => cell("p", t)));
  }

  const KINDS = ["clusters", "flowers"];

  function table(id, head, rows) {
    const line = (tag, texts) => { const tr = document.createElement("tr"); tr.append(...texts.map((t) => cell(tag, t))); return tr; };
    at(id).replaceChildren(line("th", head), ...rows.map((r) => line("td", r)));
  }

  function interval(bin) {
    const z = 1.96, n = bin.n, middle = (bin.right + z * z / (2 * n)) / (1 + z * z / n);
    const half = z * Math.sqrt(bin.right * (1 - bin.right) / n + z * z / (4 * n * n)) / (1 + z * z / n);
    return [Math.max(0, middle - half), Math.min(1, middle + half)];
  }

  function drawReliability() {
    const view = canvas("reliability"), g = view.g, side = Math.min(view.width - 60, view.height - 40);
    const nines = (p) => Math.min(-Math.log10(Math.max(1 - p, 1e-9)), 4) / 4; // the last percent is what matters
    const x = (p) => 60 + nines(p) * side, y = (p) => view.height - 30 - nines(p) * side;
    g.strokeStyle = g.fillStyle = colour("--soft"); g.font = "12px sans-serif"; g.lineWidth = 1;
    g.strokeRect(x(0), y(1), side, side);
    g.beginPath(); g.moveTo(x(0), y(0)); g.lineTo(x(1), y(1)); g.stroke();
    for (const v of [0, 0.9, 0.99, 0.999, 0.9999]) {
      g.fillText(String(v), x(v) - 8, y(0) + 16); g.fillText(String(v), 18, y(v) + 4);
    }
    g.fillText("said", x(0.9) - 42, y(0) + 16); g.save(); g.translate(12, y(0.9)); g.rotate(-Math.PI / 2); g.fillText("right", -8, 0); g.restore();
    let k = 0;
    data.judged.forEach((verdict, kind) => ["matches", "new"].forEach((what) => {
      g.strokeStyle = g.fillStyle = hue(k);
      for (const b of verdict[what]) {
        const [low, high] = interval(b);
        g.beginPath(); g.moveTo(x(b.said), y(low)); g.lineTo(x(b.said), y(high)); g.stroke();
        g.beginPath(); g.arc(x(b.said), y(b.right), 4, 0, 7); g.fill();
      }
      g.fillText(`${KINDS[kind]}, ${what === "new" ? "new" : "known again"}`, x(0) + 8, y(1) + 16 + 16 * k++);
    }));
  }

  function drawJudged() {
    at("judged").hidden = !data.judged.length;
    if (!data.judged.length) return;
    const names = ["right", "wrong", "missed", "joined", "new"], share = (v) => (100 * v).toFixed(2) + " %";
    table("confusion", ["", "right", "wrong", "missed", "falsely joined", "rightly new", "F1", "wrong of all"], data.judged.map((v, k) => [KINDS[k], ...names.map((n) => String(v.confusion[n])), v.f1.toFixed(4), share(v.wrong_share)]));
    const rows = data.judged.flatMap((v, k) => ["matches", "new"].flatMap((what) => v[what].map((b) => [KINDS[k], what === "new" ? "new" : "known again", b.said.toFixed(4), b.right.toFixed(4), String(b.n)])));
    table("bins", ["", "said to be", "sure to", "right", "decisions"], rows);
    drawReliability();
  }

  function draw() {
    const p = plant();
    at("title").textContent = `${data.map}: ${p ? p.name : "empty"}`;
    if (!p) return;
    at("says").textContent = `${p.sessions.length} sessions, ${p.clusters.length} clusters, ${p.flowers.length} flowers; clusters drift by ${p.drift_mm_per_day} mm a day (RMS).`;
    const s = p.sessions[state.day];
    at("when").textContent = s ? `${s.date || "no date"} (${s.id})` : "";
    drawScene(); drawAlignment(); drawLives(); drawChosen(); drawJudged();
  }

  function choose() {
    const slider = at("date");
    slider.max = String(Math.max(plant() ? plant().sessions.length - 1 : 0, 0));
    state.day = +slider.max; slider.value = slider.max; state.chosen = null;
    draw();
  }

  data.plants.forEach((p, k) => { const o = cell("option", p.name); o.value = String(k); at("plant").append(o); });
  at("plant").onchange = (e) => { state.plant = +e.target.value; choose(); };
  at("date").oninput = (e) => { state.day = +e.target.value; draw(); };
  const scene = at("scene");
  scene.onpointerdown = (e) => { scene.setPointerCapture(e.pointerId); scene.dataset.drag = "1"; };
  scene.onpointerup = () => { delete scene.dataset.drag; };
  scene.onpointermove = (e) => {
    if (!scene.dataset.drag) return;
    state.yaw += e.movementX / 150; state.tilt = Math.max(-1.5, Math.min(1.5, state.tilt + e.movementY / 150)); draw();
  };
  scene.onwheel = (e) => { e.preventDefault(); state.zoom *= Math.exp(-e.deltaY / 600); draw(); };
  window.onresize = draw;
  choose();
})();
