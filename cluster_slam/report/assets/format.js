// Numbers as people read them.
function digits(value) {
  if (value === null || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size < 1e-9) return "0";
  const decimals = Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(Number(size.toPrecision(2))))));
  return value.toLocaleString("en-US", { minimumFractionDigits: decimals, maximumFractionDigits: decimals });
}

function unitOf(metres) {
  const size = Math.abs(metres);
  if (size < 1e-5 && size > 1e-9) return [1e6, "µm"];
  if (size < 0.1) return [1e3, "mm"];
  return size < 1 ? [100, "cm"] : [1, "m"];
}

function length(metres) {
  if (metres === null || !Number.isFinite(metres)) return "–";
  const [factor, unit] = unitOf(metres);
  return `${digits(metres * factor)} ${unit}`;
}

const degrees = (radians) => `${digits((radians * 180) / Math.PI)}°`;
const whole = (n) => n.toLocaleString("en-US");
const seconds = (s) => `${s.toFixed(1)} s`;

function clockTime(unix) {
  return unix > 1e8 ? new Date(unix * 1000).toISOString().slice(11, 19) + " UTC" : "";
}

function plural(n, noun) {
  return `${whole(n)} ${noun}${n === 1 ? "" : "s"}`;
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[sorted.length >> 1] : 0;
}

// One unit for a whole column, from its median, with decimals that show two digits of it.
function column(values) {
  const known = values.filter((v) => v !== null && v > 0);
  const middle = median(known) || 1e-3;
  const [factor, unit] = unitOf(middle);
  const decimals = Math.min(4, Math.max(0, 1 - Math.floor(Math.log10(middle * factor))));
  return { unit, text: (v) => (v === null ? "–" : (v * factor).toFixed(decimals)) };
}
