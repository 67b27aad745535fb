// What the reader has chosen; every part of the page listens and redraws.
const state = { frame: null, cluster: null, magnify: 1, magnifyPath: false, showRejected: false, playing: false, hover: null };
const listeners = [];

function listen(callback) {
  listeners.push(callback);
}

function change(update) {
  Object.assign(state, update);
  for (const callback of listeners) callback(update);
}

function element(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined) continue;
    if (key === "class") node.className = value;
    else if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "colour") node.style.background = value;
    else if (key === "width") node.style.width = value;
    else node.setAttribute(key, value);
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

const byId = (id) => document.getElementById(id);

// Values of the theme's variables, kept until the theme changes.
const themed = new Map();
function css(name) {
  if (!themed.has(name)) themed.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return themed.get(name);
}
