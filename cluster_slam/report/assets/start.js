// Starts the page.
function redraw() {
  paint();
  legend();
  charts.forEach(drawChart);
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  themed.clear();
}

function tips() {
  document.body.append(tipBox);
  const show = (event) => {
    const holder = event.target.closest && event.target.closest("[data-tip]");
    if (!holder) return;
    const r = holder.getBoundingClientRect();
    showTip(holder.dataset.tip, r.left, r.bottom - 14);
  };
  document.addEventListener("mouseover", show);
  document.addEventListener("focusin", show);
  document.addEventListener("mouseout", (event) => event.target.closest("[data-tip]") && hideTip());
  document.addEventListener("focusout", hideTip);
}

function start() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  setTheme(dark.matches ? "dark" : "light");
  dark.addEventListener("change", () => (setTheme(dark.matches ? "dark" : "light"), redraw()));
  byId("theme").addEventListener("click", () => {
    setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    fillRejected();
    redraw();
  });
  fillSummary();
  fillRejected();
  fillNoise();
  fillCalibration();
  fillRun();
  buildTable();
  slider.step = every;
  slider.max = Math.max(0, nFrames - 1);
  slider.addEventListener("input", () => change({ frame: Number(slider.value), playing: false }));
  byId("whole").addEventListener("click", () => change({ frame: null, playing: false }));
  byId("play").addEventListener("click", () => {
    const again = state.frame === null || state.frame + every >= nFrames;
    change({ playing: !state.playing, frame: again && !state.playing ? 0 : state.frame });
    play();
  });
  byId("magnify").addEventListener("change", (event) => change({ magnify: Number(event.target.value) }));
  byId("magnify-path").addEventListener("change", (event) => change({ magnifyPath: event.target.checked }));
  byId("show-rejected").addEventListener("change", (event) => change({ showRejected: event.target.checked }));
  for (const button of document.querySelectorAll("[data-fit]")) button.addEventListener("click", () => fitView(button.dataset.fit));
  pointer();
  tips();
  lookFromCamera();
  fitView("all");
  chooseMagnify();
  fillMisfit();
  fillCoverage();
  listen((update) => {
    if ("cluster" in update) {
      markRow();
      showDetail();
    }
    document.querySelector('[data-fit="cluster"]').disabled = state.cluster === null;
    showTime();
    redraw();
  });
  change({});
  new ResizeObserver(redraw).observe(canvas);
  window.addEventListener("resize", redraw);
  window.flowerReport = { state, view, data, clusterAt };
  document.documentElement.dataset.ready = "yes";
}

start();
