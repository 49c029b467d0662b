// Worlds of a simulated robot, and the import of maps.

import { $, element, say } from "./element.js";

const card = $("main"), form = $("#world-form"), file = form.elements.map;
const MOST_LETTERS = 64, MOST_BYTES = 200;
let fresh = null;

/** Connect the world form; `take` receives a map and the name of its world. */
export function wireWorlds(take) {
  const offer = (files) => {
    for (const one of [...files].slice(0, 1)) take(one, nameOf(one));
    file.value = "";
  };
  file.onchange = () => offer(file.files);
  // A dropped file must not replace the page.
  for (const type of ["dragover", "drop"]) addEventListener(type, (event) => event.preventDefault());
  for (const type of ["dragover", "dragleave", "drop"]) {
    card.addEventListener(type, () => card.classList.toggle("over", type === "dragover" && !form.hidden));
  }
  card.addEventListener("drop", ({ dataTransfer }) => !form.hidden && offer(dataTransfer.files));
}

/** Convert a file name to a valid world name; see WorldName in schemas/rpc.py. */
function nameOf({ name }) {
  const whole = name.normalize().replace(/\.[^.]*$/, "");
  const plain = whole.replace(/[^\p{Alphabetic}\p{M}\p{Nd}\p{Pc} ().-]/gu, "-");
  const letters = [...plain.replace(/^[ ().-]+/, "")].slice(0, MOST_LETTERS);
  while (new TextEncoder().encode(letters.join("")).length > MOST_BYTES) letters.pop();
  return letters.join("") || "map";
}

/** World and variation of the next drive or run; empty for a real robot, null if unchanged. */
export function chosenWorld() {
  return form.hidden ? {} : { world: other(form.elements.world), variation: other(form.elements.variation) };
}

/** World of the next drive or run, for a robot in `here`. */
export const worldOf = (here) => (form.hidden ? here : form.elements.world.value);

const other = ({ value, dataset }) => (value === dataset.now ? null : value || null);

/** Select a new world once the robot lists it. */
export function madeWorld(name) {
  fresh = name;
}

export function drawWorlds(told) {
  form.hidden = !told.worlds;
  $(".simulated").hidden = form.hidden;
  if (form.hidden) return;
  fill(form.elements.world, told.worlds, told.world);
  fill(form.elements.variation, told.variations, told.variation);
  const { world } = form.elements;
  if ([...world.options].some(({ value }) => value === fresh)) [world.value, fresh] = [fresh, null];
}

/** Offer the names and the current one; a selection stays until the robot's own changes. */
function fill(select, told = "", here = "") {
  const now = String(here), before = select.value;
  const names = [...new Set([...String(told).split(", "), now])].filter(Boolean);
  if ([...select.options].map(({ value }) => value).join() !== names.join()) {
    select.replaceChildren(...names.map((name) => element("option", { value: name }, name)));
    select.value = names.includes(before) ? before : now;
  }
  if (select.dataset.now !== now) [select.dataset.now, select.value] = [now, now];
}

/** World that the robot must open for the next drive or run; empty if it is already open. */
export function opening() {
  const { world, variation } = form.elements;
  return Object.values(chosenWorld()).some(Boolean) ? `${world.value} (${variation.value})` : "";
}

const news = $("#world-news");

/** Show the progress of an import; an empty text hides it. */
export function showNews(text) {
  say(news, text);
  news.hidden = !text;
}
