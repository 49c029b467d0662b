// Recordings, learning, and runs with a model.

import { $, element, say } from "./element.js";
import { percent, recordingFacts } from "./words.js";
import { chosenVictim, chosenWorld, madeWorld, showNews, worldOf } from "./world.js";

const REALLY_MS = 3000;
const list = $("#recordings"), learn = $("#learn-form"), run = $("#run-form"), job = $("#job");
const chosen = new Map();
let library = { recordings: [], models: [] }, world = null;

export function wireTeaching(ask) {
  const plain = (name) => name.trim().toLowerCase().replace(/\s+/g, "-") || null;
  const begin = (what) => ask({ ...what, ...chosenWorld() });
  send($("#drive-form"), ({ goal, name }) => begin({ do: "drive", goal: goal.trim(), name: plain(name) }));
  send(learn, ({ name, scheme }) => ask({ do: "learn", name: name.trim(), scheme, recordings: picked() }));
  send(run, ({ goal = null, seed, ...what }) => begin({ do: "run", goal, seed: Number(seed), ...chosenVictim(), ...what }));
  $("#learn-today").onclick = () => ask({ do: "add", model: chosenModel().name, recordings: runsOfToday() });
  $("#cancel").onclick = () => ask({ do: "cancel" });
  list.onchange = ({ target }) => (chosen.set(target.value, target.checked), allowLearning());
  list.onclick = ({ target }) => {
    if (!target.dataset.recording) return;
    if (target.dataset.sure) return ask({ do: "delete", recording: target.dataset.recording });
    // A browser dialog would block the emergency stop.
    target.dataset.sure = "yes";
    target.textContent = "Really delete?";
    setTimeout(() => { delete target.dataset.sure; target.textContent = "Delete"; }, REALLY_MS);
  };
  run.elements.model.onchange = () => (fillGoals(), warn());
  $("#world-form").addEventListener("change", warn);
}

function send(form, what) {
  form.onsubmit = (event) => {
    event.preventDefault();
    what(Object.fromEntries(new FormData(form)));
    document.activeElement?.blur();  // return the keys to driving
  };
}

const picked = () => [...list.querySelectorAll("input:checked")].map((box) => box.value);
const allowLearning = () => (learn.querySelector("button").disabled = picked().length === 0);

/** Set the robot's world; by default only its drives are selected for learning. */
export function inWorld(now) {
  if (now !== world) {
    world = now;
    drawLibrary(library);
  }
  warn();  // the selected world follows the robot
}

export function drawLibrary(now) {
  library = now;
  drawRecordings(now.recordings);
  const empty = $("#recordings-empty");
  empty.hidden = now.recordings.length > 0;
  const elsewhere = "The recorder's folder is outside the console's root; start the stack with --root.";
  if (now.folder === null) say(empty, elsewhere);
  const names = new Set(now.models.map(({ name }) => short(name))), name = learn.elements.name;
  if (!name.value || (names.has(name.value) && document.activeElement !== name)) {
    let number = 1;
    while (names.has(`way-${number}`)) number++;
    name.value = `way-${number}`;
  }
  fillModels();
  allowLearning();
  warn();
}

const chosenModel = () => library.models.find(({ name }) => name === run.elements.model.value);

/** Today's successful runs in the worlds of the selected model, which can learn from two or more. */
function runsOfToday() {
  const { goals = [], worlds = [] } = chosenModel() ?? {}, midnight_s = new Date().setHours(0, 0, 0, 0) / 1000;
  const good = ({ purpose, outcome, useless, when_s, goal, world: where }) =>
    purpose === "run" && outcome === "found" && !useless && when_s >= midnight_s && goals.includes(goal) && worlds.includes(where);
  return library.recordings.filter(good).map(({ name }) => name);
}

/** Warn if the selected model was taught in another world, and offer today's runs for learning. */
function warn() {
  const today = runsOfToday().length, more = $("#learn-today");
  more.hidden = today < 2;
  say(more, `Learn from today's ${today} runs`);
  const { name = "", worlds = [] } = chosenModel() ?? {}, there = worldOf(world);
  const known = !there || worlds.length === 0 || worlds.includes(there);
  const taught = `${short(name)} was taught in ${worlds.join(" and ")}`;
  say($("#elsewhere"), known ? "" : `${taught}, and this run is in ${there}: the model has no route there.`);
}

let items = new Map();

/** Redraw changed items only, so that the keyboard focus stays. */
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

/** Whether a recording is selected for learning: by choice, else if it is a complete drive in this world. */
function teaches({ useless, name, purpose, outcome, world: where }) {
  return !useless && (chosen.get(name) ?? (purpose === "drive" && outcome === "found" && where === world));
}

function recordingItem(one) {
  const when = new Date(1000 * one.when_s).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
  const named = one.episode.replace(/-[^-]+-\d+$/, ""), nameless = /^((drive|run|recovery)-\d+)?$/.test(named);
  const title = `${nameless ? "" : `${named}: `}${one.purpose === "run" ? "Run" : "Drive"} to ${one.goal || "?"}`;
  const box = element("input", { type: "checkbox", value: one.name, disabled: Boolean(one.useless) });
  const text = element("span", { title: one.name }, title, element("small", {}, recordingFacts(one, when)));
  const pictures = Array.from({ length: one.thumbnails }, (_, k) => {
    const src = `thumbnail?${new URLSearchParams({ of: one.name, k })}`;
    return element("img", { alt: "", loading: "lazy", width: 72, height: 54, src });
  });
  const remove = element("button", { type: "button", "aria-label": `Delete ${title}, ${when}` }, "Delete");
  remove.dataset.recording = one.name;
  const row = element("div", { className: "thumbnails" }, ...pictures);
  return element("li", {}, element("label", {}, box, text), row, remove);
}

/** Display name of a model, without folder and suffix. */
const short = (name) => name.replace(/^models\//, "").replace(/\.smal$/, "");

let newest;

function fillModels() {
  const select = run.elements.model, before = select.value;
  const named = ({ name, goals, useless }) =>
    `${short(name)}${useless ? `: ${useless}` : goals.length ? "" : " (the paper's scheme)"}`;
  const option = (one) => element("option", { value: one.name, disabled: Boolean(one.useless) }, named(one));
  select.replaceChildren(...library.models.map(option));
  const usable = library.models.filter(({ useless }) => !useless).map(({ name }) => name);
  // Select a newly learned model.
  if (usable.length > 0) select.value = usable.includes(before) && usable[0] === newest ? before : usable[0];
  newest = usable[0];
  run.querySelector("button").disabled = usable.length === 0;
  fillGoals();
}

function fillGoals() {
  const goals = chosenModel()?.goals ?? [], { goal } = run.elements, before = goal.value;
  goal.disabled = goals.length === 0;  // the paper's scheme drives to the nearest goal
  goal.replaceChildren(...goals.map((goal) => element("option", { value: goal }, goal)));
  if (goals.includes(before)) goal.value = before;
}

let working = null;

export function drawJob({ kind, name, doing, done, stage, share, outcome, why, remarks }) {
  const tell = kind === "world" ? showNews : () => {};
  $("#cancel").hidden = Boolean(outcome);
  if (!outcome) {
    if (!job.querySelector("progress")) job.replaceChildren(element("p"), element("progress", { max: 1 }));
    const [text, bar] = job.children;
    working = name;
    say(text, [doing, stage].filter(Boolean).join(": "));
    tell(`${doing} …`);
    share === null ? bar.removeAttribute("value") : (bar.value = share);
    bar.setAttribute("aria-label", share === null ? doing : `${stage}: ${percent(share)}`);
    return;
  }
  const said = { done, cancelled: `${name} was cancelled.`, failed: `${doing} failed: ${why}` }[outcome];
  if (working === name) tell(said);
  if (working === name && kind === "world" && outcome === "done") madeWorld(name);
  const hints = remarks.filter((text) => text !== why).map((text) => element("p", { className: "hint" }, text));
  job.replaceChildren(element("p", {}, said), ...hints);
}
