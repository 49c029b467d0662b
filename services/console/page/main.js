// The page: draws updates, and sends commands.

import { drawAhead } from "./ahead.js";
import { drawBelief } from "./belief.js";
import { Box } from "./box.js";
import { wireCarry } from "./carry.js";
import { drawChoice, wireChoice } from "./choose.js";
import { Drive } from "./drive.js";
import { $, element, say } from "./element.js";
import { closeFinish, drawFinish, finished, keepPicture, wireFinish } from "./finish.js";
import { drawHealth } from "./health.js";
import { Steady, lead } from "./lead.js";
import { drawMap, showPlace } from "./map.js";
import { drawJob, drawLibrary, inWorld, known, really, startHere, wireTeaching } from "./teach.js";
import { Watch } from "./watch.js";
import { LABELS, episodeFacts, illness, seconds, teaching } from "./words.js";
import { drawWorlds, opening, showNews, wireWorlds } from "./world.js";

const OLD_S = 2, NO_WORD_S = 3, MOST_LINES = 50, LATEST_MS = 6000, NEW_MS = 500;
const camera = $("#camera canvas"), noCamera = $("#camera .empty"), pad = $("#pad");
const buttons = [...$("#actions").children], panels = [...$("#panels").children], tabs = [...$("#steps").children];
const watch = new Watch(onNews, onPicture);
const box = new Box(camera);
const drive = new Drive({ onChange: drawSeat, onRefused: tell, onStop: stop });
const told = (service) => watch.state.health?.services.find(({ name }) => name === service)?.told ?? {};

// -- updates -----------------------------------------------------------------------------------------------

const draws = {
  library: drawLibrary, job: drawJob, news: drawNews, taken: drawSeat,
  robot_id: (name) => say($("#robot"), name),
  health: (health) => {
    drawHealth(health);
    drawWorlds(told("robot"));
    inWorld(told("robot").world ?? null);
    const { disk } = told("recorder");
    say($("#disk"), disk ? `Recording: ${disk}` : "");
    $("#disk").hidden = !disk;
  },
};

function onNews(channels) {
  if (channels.length > 0 || !watch.connected) document.body.classList.add("told");
  for (const channel of channels) draws[channel]?.(watch.state[channel]);
  drawLead();
  const carries = Boolean(told("robot").worlds) && !teaching(watch.state.robot);
  $("#carry-hint").classList.toggle("absent", !carries);
  if (channels.some((one) => ["belief", "plan", "model"].includes(one))) drawBelief(watch.state, watch.age("belief"));
  if (channels.some((one) => ["pose", "way", "model", "belief", "tracked", "goal", "ground", "stands"].includes(one))) {
    drawMap(watch.state, (channel) => watch.age(channel), carries);
  }
}

async function onPicture(blob) {
  keepPicture(watch.state, blob);
  const image = await createImageBitmap(blob), { width, height } = image;
  if (camera.width !== width || camera.height !== height) Object.assign(camera, { width, height });
  const pen = camera.getContext("2d");
  pen.drawImage(image, 0, 0);
  drawAhead(pen, watch.state, (channel) => watch.age(channel));
  box.draw(pen);
  image.close();
}

const steady = new Steady();
let chosen = null, details = false, led = { does: [] }, changedMs = 0, refused = "", lastEvent = "";
/** A refusal stays in the header until the person acts. */
for (const acts of ["pointerdown", "keydown"]) addEventListener(acts, () => { refused = ""; }, true);

function link() {
  if (!watch.connected) return `Not connected to the console for ${seconds((performance.now() - watch.sinceMs) / 1000)}`;
  return watch.silence > NO_WORD_S ? `The console has been silent for ${seconds(watch.silence)}` : "";
}

/** Distance from the robot to the goal at the end of its last episode; null if unknown. */
function distance({ goal, pose }) {
  if (!goal?.at || goal.episode !== pose?.episode) return null;
  return Math.hypot(goal.at[0] - pose.pose[0], goal.at[1] - pose.pose[1]);
}

function drawLead() {
  const { robot, job, taken, health } = watch.state, { frames_hz } = told("robot"), ill = illness(health);
  const state = {
    plan: watch.age("plan") < OLD_S ? watch.state.plan?.kind : null,
    robot, job, taken, chosen, frames_hz, unattended: Boolean(health?.unattended), link: link(), age: watch.age("robot"),
    ill: ill === "robot: does not answer" ? "" : ill, sits: drive.sits, opening: drive.sits ? opening() : "",
    distance: distance(watch.state), ...known(robot),
  };
  const before = led;
  if (before.does[0] === "withdraw" && robot && !robot.waiting && !robot.episode) refused = watch.state.news?.at(-1)?.text ?? "";
  // An episode, or learning, that begins or ends leads to the next step; a change of the lists keeps a chosen step.
  const event = [robot?.episode, job?.kind === "model" && String(job.outcome)].join();
  if (event !== lastEvent) [chosen, lastEvent] = [null, event];
  led = lead({ ...state, refused, chosen });
  if (chosen === null) details &&= led.next === before.next;
  const [level, text] = steady.show(led.level, led.text, robot?.episode ?? "", performance.now());
  $(".pill").className = `pill ${level}`;
  say($("#status"), text);
  say($("#facts"), led.facts);
  $("#camera").classList.toggle("old", led.level === "old" || Boolean(state.link));
  if (led.does[0] !== before.does[0]) changedMs = performance.now();
  drawFinish(watch.state, state.distance);
  drawChoice(Boolean(told("robot").worlds) && !robot?.episode && !robot?.waiting && !state.opening);
  drawActions({ learn: state.picked > 0, run: state.usable });
  const ends = (chosen ?? "run") === "run" && finished(watch.state);
  drawPanels(details ? "more" : ends ? "finish" : led.step);
  $("#stop").setAttribute("aria-pressed", String(Boolean(robot?.emergency || robot?.cause === "emergency_stop")));
  if (robot?.episode && document.body.dataset.episode !== robot.episode) {
    showNews("");
    startHere(false);
  }
  document.body.dataset.episode = robot?.episode ?? "";
  say($("#episode"), episodeFacts(robot));
  drawCameraAge(Boolean(robot?.episode));
}

/** The next action is the large button; it rests for a moment when it changes, for a second click. */
function drawActions(possible) {
  const rests = performance.now() - changedMs < NEW_MS;
  buttons.forEach((button, k) => {
    const does = led.does[k];
    button.hidden = !does;
    if (!does) return;
    if (button.dataset.does !== does) {
      delete button.dataset.sure;
      button.dataset.does = does;
      button.textContent = LABELS[does];
      button.type = does in acts ? "button" : "submit";
      does in acts ? button.removeAttribute("form") : button.setAttribute("form", `${does}-form`);
    }
    button.setAttribute("aria-disabled", String((k === 0 && rests) || possible[does] === false));
  });
}

function drawPanels(shown) {
  for (const panel of panels) panel.classList.toggle("shown", panel.id === shown);
  for (const tab of tabs) {
    tab.setAttribute("aria-pressed", String(tab.dataset.panel === (shown === "finish" ? "run" : shown)));
    tab.dataset.panel === led.next ? tab.setAttribute("aria-current", "step") : tab.removeAttribute("aria-current");
  }
}

function drawCameraAge(running) {
  const age = watch.age("camera");
  noCamera.hidden = age !== null && (age < OLD_S || !running);
  if (!noCamera.hidden) say(noCamera, age === null ? "Waiting for the camera …" : `No camera frame for ${seconds(age)}`);
}

let lastLine = 0;

/** Add new lines only, since screen readers announce added lines. */
function drawNews(lines) {
  if (lines.at(-1).number < lastLine) lastLine = 0; // the console has restarted
  for (const { number, at, text } of lines.filter(({ number }) => number > lastLine)) {
    tell(text, new Date(Date.now() - 1000 * watch.since(at)));
    lastLine = number;
  }
}

// -- commands ----------------------------------------------------------------------------------------------

function drawSeat() {
  const seat = $("#seat"), sits = Boolean(drive?.sits), [linear, angular] = drive?.held ?? [0, 0];
  const held = { forward: linear > 0, backward: linear < 0, left: angular > 0, right: angular < 0 };
  seat.setAttribute("aria-pressed", String(sits));
  say(seat, sits ? "Leave control" : watch?.state.taken ? "Another person drives" : "Take control");
  if (drive?.held) box.clear();
  for (const button of pad.children) button.classList.toggle("held", held[button.dataset.atom]);
}

function tell(text, when = new Date()) {
  const list = $("#news");
  if (text) list.prepend(element("li", {}, element("time", {}, when.toLocaleTimeString()), text));
  if (text && Date.now() - when < LATEST_MS) showLatest(text);
  if (list.children.length > MOST_LINES) list.lastChild.remove();
  $("#news-empty").hidden = list.children.length > 0;
}

/** Show the latest news for a few seconds at any scroll position. */
function showLatest(text) {
  clearTimeout(showLatest.timer);
  say($("#latest"), text);
  showLatest.timer = setTimeout(() => say($("#latest"), ""), LATEST_MS);
}

function stop() {
  if (![watch.stop(), drive.stop()].includes(true)) tell("NOT SENT: not connected to the console.");
  else if (watch.silence > NO_WORD_S) tell("The console does not answer: the emergency stop may be late.");
}

$("#stop").onclick = stop;
$("#seat").onclick = () => (drive.sits ? drive.leave() : drive.take());
// A late press of “Resume” must not end the episode.
const end = (button) => really(button, "Really end?") && drive.ask({ do: "end", found: false });
// The other actions submit their forms.
const acts = {
  found: (button) => {
    if (watch.state.robot?.moved === false && !really(button, "Here? You have not moved")) return;
    drive.ask({ do: "end", found: true, box: box.drawn });
    box.clear();
  },
  end, quit: end,
  ...Object.fromEntries(["resume", "withdraw", "cancel"].map((what) => [what, () => drive.ask({ do: what })])),
};
for (const button of buttons) {
  button.onclick = (event) => {
    if (button.getAttribute("aria-disabled") === "true") return event.preventDefault();
    if (button.type === "button") return acts[button.dataset.does](button);
    [chosen, details] = [led.step, false];
    closeFinish();
    drawPanels(led.step);  // the browser shows what is wrong in a field
  };
}
for (const tab of tabs) {
  tab.onclick = () => {
    details = tab.dataset.panel === "more";
    if (!details) chosen = tab.dataset.panel;
    drawLead();
  };
}
const redrawMap = () => onNews(["pose"]);
function enlarge(is) {
  $("#enlarge").setAttribute("aria-pressed", String($("#map").classList.toggle("large", is)));
  redrawMap();
}
$("#enlarge").onclick = () => enlarge();
wireFinish(() => {
  [chosen, details] = ["run", false];
  drawLead();
}, tell, () => watch.state);
wireTeaching((what) => drive.ask(what));
wireCarry({
  carry: (pose) => {
    drive.ask({ do: "carry", ...pose });
    if (!watch.state.robot?.episode) startHere(true);
  },
  redraw: redrawMap,
  click: showPlace,
  tell,
});
wireChoice({
  enlarge: () => enlarge(true),
  chosen: (places) => drive.ask({ do: "task", ...places }),
  redraw: redrawMap,
});
wireWorlds(async (map, name) => {
  if (!(await drive.take())) return;
  tell(`Sending ${map.name} …`);
  try {
    const sent = { method: "POST", headers: { "smal-seat": drive.word }, body: map };
    const answer = await fetch(`map?${new URLSearchParams({ name })}`, sent);
    if (!answer.ok) tell(`${map.name}: ${await answer.text()}`);
  } catch (error) {
    tell(`${map.name}: not sent (${error.message})`);
  }
});

for (const button of pad.children) {
  const { atom } = button.dataset, isPress = ({ code }) => ["Space", "Enter"].includes(code);
  const press = async () => (await drive.take()) && button.matches(":active") && drive.press(atom);
  button.onpointerdown = (event) => {
    button.setPointerCapture(event.pointerId);
    drive.sits ? drive.press(atom) : press();
  };
  for (const lost of ["onpointerup", "onpointercancel", "onlostpointercapture", "onblur"]) {
    button[lost] = () => drive.release(atom);
  }
  // Returning false would cancel every key, and Tab could not leave the button.
  button.onkeydown = (event) => { if (isPress(event) && !event.repeat && drive.sits) drive.press(atom); };
  button.onkeyup = (event) => { if (isPress(event)) drive.release(atom); };
  button.oncontextmenu = (event) => event.preventDefault();
}
onNews(["belief", "pose"]);
setInterval(() => onNews(["belief", "pose"]), 500);
