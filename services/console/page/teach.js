// Recordings, learning, and runs with a model.

import { $, element, say } from "./element.js";
import { jobFacts, jobText, recordingFacts, reportOf } from "./words.js";
import { chosenWorld, madeWorld, showNews, worldOf } from "./world.js";

const REALLY_MS = 3000;
const NOTHING = "No recordings yet. Teach the robot first.";
const ELSEWHERE = "The recorder's folder is outside the console's root; start the stack with --root.";
const list = $("#recordings"), learn = $("#learn-form"), run = $("#run-form"), job = $("#job"), models = $("#models ul");
const chosen = new Map();
let library = { recordings: [], models: [] }, world = null, driving = null;

export function wireTeaching(ask) {
  const plain = (name) => name.trim().toLowerCase().replace(/\s+/g, "-") || null;
  const begin = (what) => ask({ ...what, ...chosenWorld() });
  send($("#drive-form"), ({ goal, name }) => begin({ do: "drive", goal: goal.trim(), name: plain(name) }));
  send(learn, ({ name, scheme }) => ask({ do: "learn", name: name.trim(), scheme, recordings: picked() }));
  send(run, ({ goal = null, kidnap, ...what }) => {
    for (const count of ["seed", "obstacles", "people"]) what[count] = Number(what[count]);
    begin({ do: "run", goal, kidnap_tick: Number(kidnap) || null, ...what });
  });
  $("#learn-today").onclick = () => ask({ do: "add", model: chosenModel().name, recordings: runsOfToday() });
  list.onchange = ({ target }) => target.type === "checkbox" && chosen.set(target.value, target.checked);
  for (const files of [list, models]) files.onclick = ({ target }) => manage(target, ask);
  run.elements.model.onchange = () => (fillGoals(), warn());
  $("#world-form").addEventListener("change", () => (fillModels(), warn()));
}

/** Let the next run start where the robot stands, or else near the world's start again. */
export function startHere(is) {
  const { start } = run.elements;
  if (is || start.value === "here") start.value = is ? "here" : "start";
}

/** Delete or rename a file; the first press asks. A browser dialog would block the emergency stop. */
function manage(button, ask) {
  const { file, does } = button.dataset;
  if (!file) return;
  const name = button.parentElement.querySelector("input[name=label]");
  if (does === "rename") {
    name.hidden = !name.hidden;
    if (!name.hidden) return name.focus();
    if (name.value && name.value !== short(file)) ask({ do: "rename", file, name: name.value });
    return;
  }
  if (really(button, "Really delete?")) ask({ do: "delete", file });
}

/** Whether a button was pressed twice within some seconds; the first press shows a question. */
export function really(button, question) {
  if (button.dataset.sure) return true;
  const before = button.textContent;
  button.dataset.sure = "yes";
  button.textContent = question;
  setTimeout(() => {
    delete button.dataset.sure;
    if (button.textContent === question) button.textContent = before;
  }, REALLY_MS);
  return false;
}

function send(form, what) {
  form.onsubmit = (event) => {
    event.preventDefault();
    what(Object.fromEntries(new FormData(form)));
    if (form.contains(document.activeElement)) document.activeElement.blur();  // return the keys to driving
  };
}

const picked = () => [...list.querySelectorAll("input:checked")].map((box) => box.value);

/** Whether a model was taught in the world of the next run, as far as known. */
function taughtHere({ worlds = [] }) {
  const here = worldOf(world);
  return !here || worlds.length === 0 || worlds.includes(here);
}

/** Facts for the header about the files in the robot's world, and whether the list lacks the drive that this page saw last. */
export function known(robot) {
  if (robot?.episode && robot.purpose === "drive") driving = robot.episode;
  const unlisted = driving !== null && !library.recordings.some(({ episode, outcome }) => episode === driving && outcome);
  if (!unlisted) driving = null;  // deleted later, it is no longer awaited
  say($("#recordings-empty"), library.folder === null ? ELSEWHERE : unlisted ? "Storing the drive …" : NOTHING);
  const here = worldOf(world), drives = library.recordings.filter((one) => teaches(one, here));
  const usable = library.models.filter((one) => !one.useless && taughtHere(one));
  const newest = Math.max(0, ...usable.map(({ when_s = 0 }) => when_s));
  return {
    drives: drives.length, models: usable.length, picked: picked().length, usable: Boolean(run.elements.model.value),
    untaught: drives.some(({ when_s }) => when_s > newest), unlisted,
  };
}

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
  $("#recordings-empty").hidden = now.recordings.length > 0;
  const names = new Set(now.models.map(({ name }) => short(name))), name = learn.elements.name;
  if (!name.value || (names.has(name.value) && document.activeElement !== name)) {
    let number = 1;
    while (names.has(`way-${number}`)) number++;
    name.value = `way-${number}`;
  }
  fillModels();
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
  const model = chosenModel() ?? { name: "" }, taught = `${short(model.name)} was taught in ${model.worlds?.join(" and ")}`;
  say($("#elsewhere"), taughtHere(model) ? "" : `${taught}, and this run is in ${worldOf(world)}: the model has no route there.`);
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
function teaches({ useless, name, purpose, outcome, world: where }, here = world) {
  return !useless && (chosen.get(name) ?? (purpose === "drive" && outcome === "found" && where === here));
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
  const row = element("div", { className: "thumbnails" }, ...pictures);
  const called = `${title}, ${when}`, [name, ...buttons] = managing(one.name, called);
  const report = element("a", { className: "report", href: reportOf(one.name), target: "_blank", "aria-label": `Report of ${called}` }, "Report");
  return element("li", {}, element("label", {}, box, text), row, name, ...(one.frames ? [report] : []), ...buttons);
}

/** Controls that rename and delete a file. */
function managing(file, called) {
  const button = (does, text) => element("button", { type: "button", "data-does": does, "data-file": file, "aria-label": `${text} ${called}` }, text);
  const name = element("input", { name: "label", value: short(file), hidden: true, maxLength: 64, "aria-label": `New name of ${called}` });
  return [name, button("rename", "Rename"), button("delete", "Delete")];
}

/** Display name of a model, without folder and suffix. */
const short = (name) => name.replace(/^.*\//, "").replace(/\.(smal|mcap)$/, "");

let newest;

function fillModels() {
  const select = run.elements.model, before = select.value;
  const named = ({ name, goals, useless }) =>
    `${short(name)}${useless ? `: ${useless}` : goals.length ? "" : " (the paper's scheme)"}`;
  const option = (one) => element("option", { value: one.name, disabled: Boolean(one.useless) }, named(one));
  select.replaceChildren(...library.models.map(option));
  const usable = library.models.filter(({ useless }) => !useless), best = (usable.find(taughtHere) ?? usable[0])?.name;
  // Select a newly learned model, and one of the world.
  if (best) select.value = usable.some(({ name }) => name === before) && best === newest ? before : best;
  newest = best;
  const rows = library.models.map(({ name, useless }) =>
    element("li", {}, element("span", {}, `${short(name)}${useless && `: ${useless}`}`), ...managing(name, short(name))));
  if (!models.contains(document.activeElement)) models.replaceChildren(...rows);
  fillGoals();
}

function fillGoals() {
  const goals = chosenModel()?.goals ?? [], { goal } = run.elements, before = goal.value;
  goal.disabled = goals.length === 0;  // the paper's scheme drives to the nearest goal
  goal.replaceChildren(...goals.map((goal) => element("option", { value: goal }, goal)));
  if (goals.includes(before)) goal.value = before;
}

let working = null;

export function drawJob(now) {
  job.replaceChildren();
  if (!now) return;
  const { kind, name, outcome, why, share, remarks } = now, text = jobText(now);
  if (!outcome) working = name;
  if (kind === "world" && working === name) showNews(text);
  if (kind === "world" && working === name && outcome === "done") madeWorld(name);
  const bar = element("progress", { max: 1, "aria-label": text });
  const facts = outcome ? "" : jobFacts(now);
  if (!outcome && share !== null) bar.value = share;
  const hints = (remarks ?? []).filter((remark) => remark !== why).map((remark) => element("p", { className: "hint" }, remark));
  job.replaceChildren(element("p", {}, facts ? `${text} ${facts}` : text), ...(outcome ? hints : [bar]));
}
