// The table of clusters: sorted by a click on a heading, a row selects its cluster.
const order = { key: "id", sign: 1 };

function columns() {
  const sure = column(scene.clusters.map((c) => c.r95));
  const moved = column(scene.clusters.map((c) => c.sway));
  const size = column(scene.clusters.map((c) => c.size));
  return [
    { key: "id", head: "Cluster", tip: "The number of the cluster in this map.", text: (c) => String(c.id) },
    { key: "n", head: "Flowers", tip: "How many flowers the cluster has.", text: (c) => String(c.n) },
    { key: "r95", head: `Sure to, ${sure.unit}`, tip: "With 95 % probability its centre at rest lies within this distance of where the map has it.", text: (c) => sure.text(c.r95) },
    { key: "seen", head: "Seen", tip: "In how many pictures at least one of its flowers was seen.", text: (c) => whole(c.seen) },
    { key: "sway", head: `Moved, ${moved.unit}`, tip: "The farthest it was seen from its place at rest, where that is more than chance.", text: (c) => (c.sway ? moved.text(c.sway) : "–") },
    { key: "size", head: `Size, ${size.unit}`, tip: "Mean distance of its flowers from its centre.", text: (c) => (c.n > 1 ? size.text(c.size) : "–") },
    { key: "misfit", head: "Misfit", tip: "Mean squared misfit of its detections over what is expected: 1 is right.", text: (c) => (c.misfit === null ? "–" : c.misfit.toFixed(2)) },
  ];
}

function buildTable() {
  const made = columns();
  const heads = made.map((c) => {
    const button = element("button", { type: "button", onclick: () => sortBy(c.key) }, element("span", { "data-tip": c.tip }, c.head));
    return element("th", { scope: "col", "data-key": c.key }, button);
  });
  const body = element("tbody");
  byId("clusters").replaceChildren(element("thead", {}, element("tr", {}, ...heads)), body);
  for (const cluster of scene.clusters) {
    const cells = made.map((c) => element("td", { class: c.key === "misfit" && cluster.misfit > 2 ? "doubt" : null }, c.text(cluster)));
    if (cluster.state !== "confirmed") cells[0].append(element("span", { class: "tag", "data-tip": "Not seen often enough to be sure that it exists." }, cluster.state));
    cells[0].prepend(element("span", { class: "dot", colour: `var(${colourOf(cluster)})` }));
    const toggle = () => change({ cluster: state.cluster === cluster.index ? null : cluster.index });
    const onkeydown = (event) => (event.key === "Enter" || event.key === " ") && (event.preventDefault(), toggle());
    body.append(element("tr", { tabindex: 0, "data-cluster": cluster.index, "aria-selected": "false", onclick: toggle, onkeydown }, ...cells));
  }
  sortRows();
}

function sortBy(key) {
  order.sign = order.key === key ? -order.sign : 1;
  order.key = key;
  sortRows();
}

function sortRows() {
  const body = byId("clusters").tBodies[0];
  const value = (tr) => scene.clusters[tr.dataset.cluster][order.key];
  const compare = (a, b) => (a === b ? 0 : a === null ? 1 : b === null ? -1 : a < b ? -order.sign : order.sign);
  body.append(...[...body.rows].sort((a, b) => compare(value(a), value(b))));
  for (const th of byId("clusters").querySelectorAll("th")) {
    if (th.dataset.key === order.key) th.setAttribute("aria-sort", order.sign > 0 ? "ascending" : "descending");
    else th.removeAttribute("aria-sort");
  }
}

function markRow() {
  for (const tr of byId("clusters").tBodies[0].rows) {
    const chosen = Number(tr.dataset.cluster) === state.cluster;
    tr.setAttribute("aria-selected", String(chosen));
    if (chosen) scrollWithin(tr.closest(".scroll"), tr);
  }
}

function scrollWithin(box, node) {
  const top = node.offsetTop - 40;
  if (top < box.scrollTop || node.offsetTop + node.offsetHeight > box.scrollTop + box.clientHeight) box.scrollTop = top;
}
