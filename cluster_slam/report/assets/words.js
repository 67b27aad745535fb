// Puts words and tables in place, and ties the controls to the state.
function fillSummary() {
  byId("kicker").textContent = [`Session ${data.session}`, data.plant && `plant ${data.plant}`, data.scene.start > 1e8 && new Date(data.scene.start * 1000).toISOString().slice(0, 16).replace("T", " ") + " UTC"].filter(Boolean).join(" · ");
  byId("headline").textContent = data.headline;
  byId("sentences").textContent = data.sentences.join(" ");
  const names = { bad: "Wrong. ", warn: "Doubtful. ", note: "Note. " };
  const items = data.findings.map((f) => element("li", { class: f.level }, element("b", {}, names[f.level]), f.text));
  if (!data.findings.some((f) => f.level !== "note")) items.unshift(element("li", { class: "good" }, element("b", {}, "Nothing. "), "No warning was raised while this map was made."));
  byId("findings").replaceChildren(...items);
  byId("tiles").replaceChildren(
    ...data.tiles.map((t) => element("div", { class: t.level }, element("dt", {}, element("span", { "data-tip": t.tip }, t.label)), element("dd", { class: "value" }, t.value), element("dd", { class: "more" }, t.detail))),
  );
}

function fillRejected() {
  const most = Math.max(...data.rejected.map(([, n]) => n), 1);
  const total = data.accepted + data.rejected.reduce((sum, [, n]) => sum + n, 0) || 1;
  const line = ([reason, n]) => {
    const bar = reason ? element("span", { width: `${(100 * n) / most}%` }) : "";
    return element("tr", {}, element("td", { class: "text" }, element("span", { "data-tip": data.reasons[reason].sentence }, data.reasons[reason].short)), element("td", {}, whole(n)), element("td", {}, `${((100 * n) / total).toFixed(1)} %`), element("td", { class: "bar-cell" }, bar));
  };
  const head = element("tr", {}, ...["What became of it", "Detections", "Share", ""].map((text, i) => element("th", { class: i ? null : "text" }, text)));
  byId("rejected").replaceChildren(head, ...[[0, data.accepted], ...data.rejected].map(line));
}

function noiseText(value, unit) {
  if (value === null) return "–";
  if (unit === "m") return length(value);
  if (unit === "rad") return degrees(value);
  if (unit === "px") return `${digits(value)} px`;
  return unit === "depth" ? `${digits(value * 1000)} mm at 1 m` : `${digits(100 * value)} %`;
}

function fillNoise() {
  const rows = data.noise.map((n) => [n.name, noiseText(n.stated, n.unit), noiseText(n.estimated, n.unit), n.stated ? `× ${digits(n.estimated / n.stated)}` : "–"]);
  if (rows.length) byId("noise").replaceChildren(element("p", { class: "hint" }, "Standard deviations, as the session states them and as the data show them."), plainTable(["Error of", "Stated", "Found", "Ratio"], rows));
  else byId("noise").replaceChildren(element("p", { class: "hint" }, "The noise of this session was not estimated."));
}

function fillCalibration() {
  const c = data.calibration;
  if (!c) {
    byId("calibration").replaceChildren(element("p", { class: "hint" }, "Not estimated: the session gives the poses of the camera itself."));
    return;
  }
  const axes = ["turn about right", "turn about down", "turn about forward", "shift right", "shift down", "shift forward"];
  const text = (v, i) => (i < 3 ? `${((v * 180) / Math.PI).toFixed(3)}°` : `${(v * 1000).toFixed(2)} mm`);
  const rows = axes.map((axis, i) => [axis, text(c.before[i], i), text(c.after[i], i), text(c.correction[i], i), `± ${text(c.stated[i], i)}`, `± ${text(c.sigma[i], i)}`]);
  const hint = element("p", { class: "hint" }, "The hand-eye transform: camera axes as seen from the robot's flange. The correction is along and about the camera's own axes; ± is one standard deviation.");
  const parts = [hint, plainTable(["", "Before", "After", "Correction", "Believed to", "Known to"], [...rows.slice(3), ...rows.slice(0, 3)])];
  if (c.unobserved.length) parts.push(element("p", { class: "hint" }, `Not determined by the motion of the camera: ${c.unobserved.join(", ")}.`));
  byId("calibration").replaceChildren(...parts);
}

function fillMisfit() {
  const m = data.misfit;
  if (!m.t.length) {
    byId("misfit-words").textContent = "No detection was accepted, so there is nothing to compare.";
    return;
  }
  byId("misfit-words").textContent = `Squared misfit of accepted detections (NIS over its degrees of freedom), each detection against what all the others say of it. It should be near 1 and inside the shaded band 95 % of the time; here ${(100 * m.inside).toFixed(0)} %. Above the band the map is too confident.`;
  const sorted = [...m.mean].sort((a, b) => a - b);
  const top = Math.max(1.6, 1.15 * sorted[Math.floor(0.98 * (sorted.length - 1))], Math.min(3, Math.max(...m.high)));
  const read = (t) => {
    const i = nearest(m.t, t);
    return `${seconds(m.t[i])}: ${m.mean[i].toFixed(2)} (expected ${m.low[i].toFixed(2)} to ${m.high[i].toFixed(2)}, ${plural(m.n[i], "detection")})`;
  };
  const layers = [{ kind: "band", t: m.t, low: m.low, high: m.high }, { kind: "level", v: 1 }, { kind: "line", t: m.t, v: m.mean, colour: "--accent" }, { kind: "dots", t: m.t, v: m.mean, colour: "--accent" }];
  chart(byId("misfit"), { range: [0, top], layers, read, height: 220, label: "Misfit over time with its 95 % band" });
}

function fillCoverage() {
  if (!data.coverage.length) return;
  byId("coverage-title").hidden = false;
  const colours = { "position gate": "--accent", "descriptor gate": "--c4", "full geometry gate": "--c5", "flowers against truth": "--c1", "clusters against truth": "--c2" };
  const key = data.coverage.map((c) => {
    const sample = element("span", { class: "dot", colour: `var(${colours[c.name]})` });
    return element("li", {}, sample, `${c.name} (${whole(c.n)}): ${(100 * c.actual[9]).toFixed(1)} % inside 95 %`);
  });
  const widest = data.coverage[data.coverage.length - 1];
  const layers = [{ kind: "band", t: widest.nominal, low: widest.low, high: widest.high }, { kind: "line", t: [0, 1], v: [0, 1], colour: "--soft", dash: [4, 3] }];
  for (const c of data.coverage) {
    layers.push({ kind: "line", t: [0, ...c.nominal], v: [0, ...c.actual], colour: colours[c.name] });
    layers.push({ kind: "dots", t: c.nominal, v: c.actual, colour: colours[c.name], size: 2 });
  }
  const read = (p) => {
    const i = nearest(widest.nominal, p);
    return [`Should be ${Math.round(100 * widest.nominal[i])} %`, ...data.coverage.map((c) => `${c.name}: ${(100 * c.actual[i]).toFixed(1)} %`)].join("; ");
  };
  const box = element("div");
  byId("coverage").replaceChildren(box, element("ul", { class: "legend" }, ...key));
  chart(box, { range: [0, 1], domain: [0, 1], xlabel: "probability", layers, read, height: 230, label: "Actual against nominal probability" });
}

function fillRun() {
  const r = data.run;
  const join = (o, f) => Object.entries(o).map(([k, v]) => `${k.replaceAll("_", " ")} ${f(v)}`).join(", ");
  const rows = [["Command", `cluster-slam ${data.command}`], ["Version", r.version], ["Seed", String(r.seed)], ["Poses given", `${r.pose_frame.replace("T_world_", "of the ")}, errors ${r.pose_error === "odometry" ? "add up (odometry)" : "each for itself"}`]];
  if (Object.keys(r.timings).length) rows.push(["Time taken", join(r.timings, seconds)]);
  if (Object.keys(r.counts).length) rows.push(["Counts", join(r.counts, whole)]);
  if (Object.keys(r.config).length) rows.push(["Options", element("details", {}, element("summary", {}, "show"), JSON.stringify(r.config).replaceAll(/["{}]/g, "").replaceAll(/[,:]/g, "$& "))]);
  byId("run").replaceChildren(...rows.map(([a, b]) => element("tr", {}, element("td", { class: "text" }, a), element("td", { class: "text" }, b))));
  byId("scores-card").hidden = !data.scores.length;
  byId("scores").replaceChildren(...data.scores.map((s) => element("tr", {}, element("td", { class: "text" }, element("span", { "data-tip": s.tip }, s.label)), element("td", {}, s.value))));
}

const tipBox = element("div", { id: "tip", role: "tooltip", hidden: "" });
function showTip(text, x, y) {
  tipBox.textContent = text;
  tipBox.hidden = false;
  const { offsetWidth: w, offsetHeight: h } = tipBox;
  tipBox.style.left = `${Math.max(6, Math.min(x + 12, innerWidth - w - 8))}px`;
  tipBox.style.top = `${y + 18 + h > innerHeight ? y - h - 10 : y + 18}px`;
}
function hideTip() {
  tipBox.hidden = true;
}
