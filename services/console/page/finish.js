// The finish of a run: a time line through its pictures, its path on the map, a film strip, a report and a video.

import { $, color, element, say } from "./element.js";
import { drawPlaces, placesOf } from "./map.js";
import { capital, finishFacts, reportOf, seconds } from "./words.js";

// Kept pictures: five a second for the first minute. If there are too many, every second picture is dropped.
const APART_S = 0.2, MOST = 300, MOST_BYTES = 16e6;
const WIDTH = 640, HEIGHT = 480, BAR = 48, STRIP = 6, ZOOM = 1.5;
const VIDEO_HZ = 15, BITS_S = 4e6, LAST_MS = 1000;  // so a video takes at most 20 s
const TYPES = { "video/mp4;codecs=avc1.42E01F": "mp4", "video/webm": "webm" };
const FETCHED_MS = 60_000;  // time of the browser to write the file
const card = $("#finish"), [camera, map] = card.querySelectorAll("canvas"), bar = card.querySelector("input");
const film = $("#finish .film"), report = $("#report"), saving = $("#save-video"), again = $("#last-run");

let run = null, closed = true, last = null, loading = false;

/** Keep a picture of the running run, with the time and the robot's position. */
export function keepPicture({ robot, pose, belief }, picture) {
  if (!robot?.episode || robot.purpose !== "run") return;
  if (run?.episode !== robot.episode) begin(robot.episode);
  const here = pose?.episode === robot.episode ? pose.pose : belief?.pose ?? null;
  run.latest = { s: robot.seconds ?? 0, picture, here };
  if (run.latest.s - (run.moments.at(-1)?.s ?? -Infinity) >= run.apartS) keep(run.latest);
}

function begin(episode) {
  for (const image of film.querySelectorAll("img")) URL.revokeObjectURL(image.src);
  film.replaceChildren();
  [run, closed] = [{ episode, moments: [], bytes: 0, apartS: APART_S, end: null, shown: null }, true];
}

function keep(moment) {
  run.moments.push(moment);
  run.bytes += moment.picture.size;
  if (run.moments.length <= MOST && run.bytes <= MOST_BYTES) return;
  run.moments = run.moments.filter((_, k) => k % 2 === 0);
  run.bytes = run.moments.reduce((sum, { picture }) => sum + picture.size, 0);
  run.apartS *= 2;
}

/** Show the end of the last run, from its recording after a reload; `off` is the distance to the goal in metres, or null. */
export function drawFinish(state, off) {
  const { robot, driven, goal } = state;
  if (!robot?.episode && !run) offer(state);
  again.hidden = Boolean(robot?.episode || robot?.waiting) || !(run?.end || last);
  if (robot?.episode && robot.purpose !== "run") closed = true;
  if (robot?.episode || !run) return;
  if (!run.end) {
    if (!robot?.outcome || robot.purpose !== "run") return;
    if (run.moments.at(-1) !== run.latest) run.moments.push(run.latest);
    finish(state, { ...robot, metres: null });
  }
  if (driven?.episode === run.episode) run.end.metres = driven.metres;
  if (goal?.episode === run.episode) run.end.off ??= off;
  run.end.facts = finishFacts(run.end);
  say(card.querySelector(".facts"), run.end.facts);
  const recording = recordingOf(state, run.episode);
  if (recording) report.href = reportOf(recording.name);
  else report.removeAttribute("href");
}

const recordingOf = ({ library }, id) => library?.recordings.find(({ episode }) => episode === id);

/** Offer the last recorded run; if the last episode was a run, show it at once. */
function offer(state) {
  const { robot, driven, library } = state, ran = Boolean(robot?.outcome) && robot.purpose === "run";
  const of = ({ purpose, frames, episode }) => purpose === "run" && frames > 0 && (!ran || !driven || episode === driven.episode);
  const first = last === null;
  last = library?.recordings.find(of) ?? null;
  if (first && last && ran) load(state);
}

/** Load the last run from its recording; `shown` is called when the card has it. */
async function load(state, shown = () => {}) {
  if (loading) return;
  loading = true;
  const recording = last;
  try {
    const answer = await fetch(`moments?${new URLSearchParams({ of: recording.name })}`);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const { metres, true: inWorld, moments } = await answer.json();
    if (run) return;  // another run has begun
    if (moments.length === 0) throw new Error(`${recording.name}: no picture`);
    begin(recording.episode);
    run.moments = moments.map(({ picture, ...moment }) => ({ ...moment, picture: blobOf(picture) }));
    finish(state, { ...recording, metres });
    if (!inWorld) Object.assign(run.end.places, { taught: [], ground: null, victim: null });
    show(run.shown);
    shown();
  } catch (error) {
    tell(`Last run not shown: ${error.message}`);
  } finally {
    loading = false;
  }
}

const blobOf = (base64) => new Blob([Uint8Array.from(atob(base64), (one) => one.charCodeAt(0))], { type: "image/jpeg" });

function finish(state, { result, seconds: s, kidnapped, metres }) {
  const title = capital(result);
  run.end = { s, title, kidnapped, metres, off: null, places: placesOf(state, run.episode) };
  run.path = run.moments.map(({ here }) => here).filter(Boolean);
  say($("#finish-title"), title);
  bar.max = run.moments.length - 1;
  const last = run.moments.length - 1, count = Math.min(STRIP, run.moments.length);
  film.replaceChildren(...Array.from({ length: count }, (_, j) => {
    const k = Math.round((j * last) / Math.max(count - 1, 1)), { s, picture } = run.moments[k];
    const image = element("img", { alt: "", src: URL.createObjectURL(picture) });
    return element("button", { type: "button", "aria-label": `Show ${seconds(s)}`, onclick: () => show(k) }, image);
  }));
  closed = false;
  show(last);
}

/** Whether the finish replaces the settings of the next run. */
export const finished = ({ robot }) => Boolean(run?.end) && !closed && !robot?.episode && !robot?.waiting;

export function closeFinish() {
  closed = true;
}

/** Show a moment of the run on the card. */
function show(k) {
  run.shown = k;
  bar.value = k;
  const text = `${seconds(run.moments[k].s)} of ${seconds(run.moments.at(-1).s)}`;
  say(card.querySelector("label span"), `Time in the run: ${text}`);
  bar.setAttribute("aria-valuetext", text);
  const seen = run;
  return draw(run, k, camera, map, () => run === seen && run.shown === k);
}

/** Draw camera and map of a moment, unless another moment was chosen while the picture was decoded. */
async function draw({ moments, path, end }, k, camera, map, current = () => true) {
  const { picture, here } = moments[k], image = await createImageBitmap(picture);
  if (!current()) return image.close();
  for (const canvas of [camera, map]) Object.assign(canvas, { width: WIDTH, height: HEIGHT });
  const scale = Math.min(WIDTH / image.width, HEIGHT / image.height), size = [image.width * scale, image.height * scale];
  camera.getContext("2d").drawImage(image, (WIDTH - size[0]) / 2, (HEIGHT - size[1]) / 2, ...size);
  image.close();
  const pen = map.getContext("2d");
  pen.fillStyle = color("page");
  pen.fillRect(0, 0, WIDTH, HEIGHT);
  pen.scale(ZOOM, ZOOM);  // lines stay visible on the small card
  const drawn = drawPlaces(pen, [WIDTH / ZOOM, HEIGHT / ZOOM], { ...end.places, path });
  if (here) drawn.arrow(here, "good", true);
}

/** Play the run into a video of camera and map, and download it. */
async function save(saved) {
  const [camera, map] = [element("canvas"), element("canvas")];
  const video = element("canvas", { width: 2 * WIDTH, height: HEIGHT + BAR }), pen = video.getContext("2d");
  const type = Object.keys(TYPES).find((one) => MediaRecorder.isTypeSupported(one)), parts = [];
  const recorder = new MediaRecorder(video.captureStream(VIDEO_HZ), { mimeType: type, videoBitsPerSecond: BITS_S });
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.start();
  for (const [k, { s }] of saved.moments.entries()) {
    await visible(recorder);
    await draw(saved, k, camera, map);
    pen.fillStyle = color("card");
    pen.fillRect(0, HEIGHT, 2 * WIDTH, BAR);
    pen.drawImage(camera, 0, 0);
    pen.drawImage(map, WIDTH, 0);
    Object.assign(pen, { fillStyle: color("ink"), font: "600 24px system-ui, sans-serif", textBaseline: "middle" });
    pen.fillText(`${saved.end.title}: ${saved.end.facts}`, 16, HEIGHT + BAR / 2, 2 * WIDTH - 150);
    pen.fillText(seconds(s), 2 * WIDTH - 100, HEIGHT + BAR / 2);
    say(saving, `Saving ${Math.round((100 * k) / saved.moments.length)} %`);
    await after(1000 / VIDEO_HZ);
  }
  await after(LAST_MS);
  const stopped = new Promise((done) => (recorder.onstop = done));
  recorder.stop();
  await stopped;
  const href = URL.createObjectURL(new Blob(parts, { type }));
  element("a", { href, download: `${saved.episode}.${TYPES[type]}` }).click();
  setTimeout(() => URL.revokeObjectURL(href), FETCHED_MS);
}

const after = (ms) => new Promise((done) => setTimeout(done, ms));

/** Wait until the page is visible: browsers slow the timers of hidden pages. */
async function visible(recorder) {
  if (!document.hidden) return;
  recorder.pause();
  while (document.hidden) await new Promise((done) => document.addEventListener("visibilitychange", done, { once: true }));
  recorder.resume();
}

let tell;

/** Connect the controls: `redraw` draws the panels, `told` shows a line of news, `state` returns the page's state. */
export function wireFinish(redraw, told, state) {
  tell = told;
  bar.oninput = () => show(Number(bar.value));
  const open = (is) => () => {
    closed = !is;
    redraw();
  };
  $("#close-finish").onclick = open(false);
  again.onclick = () => (run ? open(true)() : load(state(), redraw));
  saving.onclick = async () => {
    if (saving.getAttribute("aria-disabled") === "true") return;
    saving.setAttribute("aria-disabled", "true");
    try {
      await save(run);
    } catch (error) {
      tell(`Video not saved: ${error.message}`);
    }
    saving.removeAttribute("aria-disabled");
    say(saving, "Save as video");
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => run?.end && show(run.shown));
}
