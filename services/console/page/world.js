// The world that a simulated robot is in, those that it can be in, and maps that become worlds.

import { $, element, say } from "./element.js";

const card = $("#map"), form = $("#world-form"), file = form.elements.map;
const MOST_LETTERS = 64, MOST_BYTES = 200;
let fresh = null;

/** Wire the choice of a world; a map is handed to `take` with the name that its world will have. */
export function wireWorlds(take) {
  const offer = (files) => {
    for (const one of [...files].slice(0, 1)) take(one, nameOf(one));
    file.value = "";
  };
  file.onchange = () => offer(file.files);
  // A file that is dropped beside the card must not open in the place of the page.
  for (const type of ["dragover", "drop"]) addEventListener(type, (event) => event.preventDefault());
  for (const type of ["dragover", "dragleave", "drop"]) {
    card.addEventListener(type, () => card.classList.toggle("over", type === "dragover" && !form.hidden));
  }
  card.addEventListener("drop", ({ dataTransfer }) => !form.hidden && offer(dataTransfer.files));
}

/** The name of a file as one that a world may have; see WorldName in schemas/rpc.py. */
function nameOf({ name }) {
  const whole = name.normalize().replace(/\.[^.]*$/, "");
  const plain = whole.replace(/[^\p{Alphabetic}\p{M}\p{Nd}\p{Pc} ().-]/gu, "-");
  const letters = [...plain.replace(/^[ ().-]+/, "")].slice(0, MOST_LETTERS);
  while (new TextEncoder().encode(letters.join("")).length > MOST_BYTES) letters.pop();
  return letters.join("") || "map";
}

/** Where the next drive or run is to be; nothing where the robot is real, or is to stay where it is. */
export function chosenWorld() {
  return form.hidden ? {} : { world: other(form.elements.world), variation: other(form.elements.variation) };
}

/** How the victim of the next run lies, in simulation. */
export const chosenVictim = () => (form.hidden ? {} : { victim: form.elements.victim.value });

/** The world of the next drive or run, for a robot that is in `here`. */
export const worldOf = (here) => (form.hidden ? here : form.elements.world.value);

const other = ({ value, dataset }) => (value === dataset.now ? null : value || null);

/** Take note of a world that has just been made: it is chosen when the robot knows it. */
export function madeWorld(name) {
  fresh = name;
}

export function drawWorlds(told) {
  form.hidden = !told.worlds;
  if (form.hidden) return;
  fill(form.elements.world, told.worlds, told.world);
  fill(form.elements.variation, told.variations, told.variation);
  const { world } = form.elements;
  if ([...world.options].some(({ value }) => value === fresh)) [world.value, fresh] = [fresh, null];
}

/** Offer what there is, and where the robot is in any case; what is chosen stays so until the robot is elsewhere. */
function fill(select, told = "", here = "") {
  const now = String(here), before = select.value;
  const names = [...new Set([...String(told).split(", "), now])].filter(Boolean);
  if ([...select.options].map(({ value }) => value).join() !== names.join()) {
    select.replaceChildren(...names.map((name) => element("option", { value: name }, name)));
    select.value = names.includes(before) ? before : now;
  }
  if (select.dataset.now !== now) [select.dataset.now, select.value] = [now, now];
}

/** What the robot would have to open for the next drive or run, which takes a while; nothing where it is there. */
export function opening() {
  const { world, variation } = form.elements;
  return Object.values(chosenWorld()).some(Boolean) ? `${world.value} (${variation.value})` : "";
}

const news = card.querySelector(".empty");

/** Show what becomes of a map, on the place of the drawing, which moves nothing; without a text, the drawing. */
export function showNews(text) {
  say(news, text);
  news.hidden = !text;
}
