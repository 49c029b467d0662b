// Helpers for elements; text is never parsed as markup.

export const $ = (selector) => document.querySelector(selector);

/** Create an element; unknown properties become attributes. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

/** Set a text only if it changes, so that screen readers announce changes only. */
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Fit a canvas to its container's width and pixel ratio; returns its cleared context (CSS pixels) and width. */
export function cleared(canvas, height) {
  const ratio = devicePixelRatio, width = canvas.clientWidth;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return [pen, width];
}

const colors = new Map();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colors.clear());

/** Colour of the current colour scheme. */
export function color(name) {
  if (!colors.has(name)) colors.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`));
  return colors.get(name);
}
