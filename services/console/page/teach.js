// Recordings, learning, and running what was learned.

import { $, element, percent, say } from "./element.js";
import { chosenWorld, madeWorld, showNews, worldOf } from "./world.js";

export const OUTCOMES = { found: "found", collision: "collision", timeout: "time was out", aborted: "ended before the goal" };
const REALLY_MS = 3000;
const list = $("#recordings"), learn = $("#learn-form"), run = $("#run-form"), job = $("#job");
const chosen = new Map();

export function wireTeaching(ask) {
  $("#drive-form").onsubmit = (event) => send(event, ({ goal, name }) => ask({ do: "drive", goal: goal.trim(), name: name.trim().toLowerCase().replace(/\s+/g, "-") || null, ...chosenWorld() }));
  learn.onsubmit = (event) => send(event, ({ name, scheme }) => ask({ do: "learn", name: name.trim(), scheme, recordings: picked() }));
  run.onsubmit = (event) => send(event, ({ model, goal, start, seed }) => ask({ do: "run", model, goal: goal ?? null, start, seed: Number(seed), ...chosenWorld() }));
  $("#cancel").onclick = () => ask({ do: "cancel" });
  list.onchange = ({ target }) => (chosen.set(target.value, target.checked), allowLearning());
  list.onclick = ({ target }) => {
    if (!target.dataset.recording) return;
    if (target.dataset.sure) return ask({ do: "delete", recording: target.dataset.recording });
    // No dialog of the browser's: while one is open the page could not stop the robot.
    target.dataset.sure = "yes";
    target.textContent = "Really delete?";
    setTimeout(() => { delete target.dataset.sure; target.textContent = "Delete"; }, REALLY_MS);
  };
  run.elements.model.onchange = () => (fillGoals(), warn());
  $("#world-form").addEventListener("change", warn);
}

function send(event, what) {
  event.preventDefault();
  what(Object.fromEntries(new FormData(event.target)));
  document.activeElement?.blur();  // the keys are for driving again
}

const picked = () => [...list.querySelectorAll("input:checked")].map((box) => box.value);

function allowLearning() {
  learn.querySelector("button").disabled = picked().length === 0;
}

let library = { recordings: [], models: [] }, world = null;

/** Take note of where the robot is: what was driven elsewhere is not chosen to learn from, unless somebody does. */
export function inWorld(now) {
  if (now !== world) {
    world = now;
    drawLibrary(library);
  }
  warn();  // the choice of a world follows the robot, and may have changed too
}

export function drawLibrary(now) {
  library = now;
  drawRecordings(now.recordings);
  const empty = $("#recordings-empty");
  empty.hidden = now.recordings.length > 0;
  if (now.folder === null) say(empty, "The recorder records outside of the console's folder; start the stack with --root.");
  const names = new Set(now.models.map(({ name }) => name.split("/").at(-1)));
  const name = learn.elements.name;
  if (!name.value || (names.has(`${name.value}.smal`) && document.activeElement !== name)) {
    let number = 1;
    while (names.has(`way-${number}.smal`)) number++;
    name.value = `way-${number}`;
  }
  fillModels();
  allowLearning();
  warn();
}

/** Say where the chosen model was taught, unless that is where the run will be. */
function warn() {
  const { name, worlds = [] } = library.models.find(({ name }) => name === run.elements.model.value) ?? {}, there = worldOf(world);
  say($("#elsewhere"), worlds.length === 0 || !there || worlds.includes(there) ? "" : `${short(name)} was taught in ${worlds.join(" and ")}, and this run is in ${there}: it knows no way there.`);
}

let items = new Map();

/** Draw anew what has changed alone: who is in the list by keys stays there. */
function drawRecordings(recordings) {
  const known = items;
  items = new Map();
  for (const one of recordings) {
    const key = JSON.stringify(one), item = known.get(key) ?? recordingItem(one);
    items.set(key, item);
    item.querySelector("input").checked = teaches(one);
  }
  const now = [...items.values()];
  for (const item of [...list.children]) if (!now.includes(item)) item.remove();
  now.forEach((item, k) => list.children[k] !== item && list.insertBefore(item, list.children[k] ?? null));
}

/** Whether it is learned from: as somebody has chosen, else what was driven here to the end. */
function teaches(one) {
  return !one.useless && (chosen.get(one.name) ?? (one.purpose === "drive" && one.outcome === "found" && one.world === world));
}

function recordingItem(one) {
  const when = new Date(1000 * one.when_s).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
  const named = one.episode.replace(/-[^-]+-\d+$/, ""), name = /^(drive|run|recovery)-\d+$/.test(named) ? "" : named;
  const title = `${name && `${name}: `}${one.purpose === "run" ? "Run" : "Drive"} to ${one.goal || "?"}`;
  const facts = one.useless || `${OUTCOMES[one.outcome] ?? "end not recorded"}${one.corrected ? ", corrected by hand" : ""}, ${one.world}, ${Math.round(one.seconds)} s, ${one.frames} frames, ${when}`;
  const box = element("input", { type: "checkbox", value: one.name, disabled: Boolean(one.useless) });
  const pictures = Array.from({ length: one.thumbnails }, (_, k) => element("img", { alt: "", loading: "lazy", width: 72, height: 54, src: `thumbnail?${new URLSearchParams({ of: one.name, k })}` }));
  const text = element("span", {}, title, element("small", {}, facts));
  text.title = one.name;
  const remove = element("button", { type: "button", "aria-label": `Delete ${title}, ${when}` }, "Delete");
  remove.dataset.recording = one.name;
  return element("li", {}, element("label", {}, box, text), element("div", { className: "thumbnails" }, ...pictures), remove);
}

/** A model as one has named it: where it lies means nothing here. */
const short = (name) => name.replace(/^models\//, "").replace(/\.smal$/, "");

function fillModels() {
  const select = run.elements.model, before = select.value;
  const options = library.models.map(({ name, goals, useless }) => element("option", { value: name, disabled: Boolean(useless) }, useless ? `${short(name)}: ${useless}` : goals.length ? short(name) : `${short(name)} (the paper's scheme)`));
  select.replaceChildren(...options);
  const usable = library.models.filter(({ useless }) => !useless).map(({ name }) => name);
  // The newest model is the one that somebody has just learned.
  if (usable.includes(before) && usable[0] === fillModels.newest) select.value = before;
  else if (usable.length > 0) select.value = usable[0];
  fillModels.newest = usable[0];
  run.querySelector("button").disabled = usable.length === 0;
  fillGoals();
}

function fillGoals() {
  const goals = library.models.find(({ name }) => name === run.elements.model.value)?.goals ?? [];
  const { goal } = run.elements, before = goal.value;
  goal.disabled = goals.length === 0;  // the paper's scheme goes to the nearest one
  run.elements.goal.replaceChildren(...goals.map((goal) => element("option", { value: goal }, goal)));
  if (goals.includes(before)) run.elements.goal.value = before;
}

let working = null;

export function drawJob(now) {
  const works = !now.outcome;
  $("#cancel").hidden = !works;
  if (works) {
    if (!job.querySelector("progress")) job.replaceChildren(element("p"), element("progress", { max: 1 }));
    working = now.name;
    say(job.firstChild, [now.doing, now.stage].filter(Boolean).join(": "));
    if (now.kind === "world") showNews(`${now.doing} …`);
    now.share === null ? job.lastChild.removeAttribute("value") : (job.lastChild.value = now.share);
    job.lastChild.setAttribute("aria-label", now.share === null ? now.doing : `${now.stage}: ${percent(now.share)}`);
    return;
  }
  if (now.kind === "world" && now.outcome === "done" && working === now.name) madeWorld(now.name);
  const said = { done: now.done, cancelled: `${now.name} was cancelled.`, failed: `${now.doing} failed: ${now.why}` };
  if (now.kind === "world" && working === now.name) showNews(said[now.outcome]);
  job.replaceChildren(element("p", {}, said[now.outcome]), ...now.remarks.filter((text) => text !== now.why).map((text) => element("p", { className: "hint" }, text)));
}
