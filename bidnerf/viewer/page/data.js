// Decodes the state of the page, and makes elements whose text is always text.

const KINDS = { int8: Int8Array, uint8: Uint8Array, uint16: Uint16Array, float32: Float32Array };

export function numbers(packed) {
  const text = atob(packed.base64),
    bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new KINDS[packed.type](bytes.buffer);
}

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && typeof value !== "string") made[name] = value;
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

// Text in which what stands between backticks is code.
export function withCode(text) {
  return text.split("`").map((part, i) => (i % 2 ? element("code", {}, part) : part));
}

export const find = (id) => document.getElementById(id);

// A length in the unit of the map: metres are shown as mm, cm or m.
export function lengthText(value, unit) {
  if (unit !== "m") return `${Number(value.toPrecision(3))} ${unit}`;
  if (value < 0.01) return `${Number((1000 * value).toPrecision(2))} mm`;
  if (value < 1) return `${Number((100 * value).toPrecision(3))} cm`;
  return `${Number(value.toPrecision(3))} m`;
}

export function percent(p) {
  if (p > 0.9995) return ">\u00a099.9%";
  return p < 0.001 ? "<\u00a00.1%" : `${Number((100 * p).toPrecision(p < 0.01 ? 1 : 3))}%`;
}

export function colourOf(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// Colours from dark blue over green to yellow, for t from 0 to 1.
const SCALE = [
  [0.24, 0.29, 0.54],
  [0.17, 0.49, 0.56],
  [0.13, 0.66, 0.52],
  [0.56, 0.84, 0.27],
  [0.99, 0.91, 0.14],
];

export function scaleColour(t) {
  const x = Math.max(0, Math.min(0.9999, t)) * (SCALE.length - 1),
    i = Math.floor(x),
    f = x - i;
  return SCALE[i].map((value, k) => value + f * (SCALE[i + 1][k] - value));
}

export const scaleGradient = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map((t) => `rgb(${scaleColour(t).map((v) => Math.round(255 * v))})`)})`;
