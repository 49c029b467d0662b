// The page: draws updates, and sends commands.

import { drawAhead } from "./ahead.js";
import { drawBelief } from "./belief.js";
import { Box } from "./box.js";
import { Drive } from "./drive.js";
import { $, element, say } from "./element.js";
import { drawHealth } from "./health.js";
import { drawMap } from "./map.js";
import { drawJob, drawLibrary, inWorld, wireTeaching } from "./teach.js";
import { Watch } from "./watch.js";
import { episodeFacts, illness, robotStatus, seconds } from "./words.js";
import { drawWorlds, opening, showNews, wireWorlds } from "./world.js";

const OLD_S = 1, NO_WORD_S = 3, MOST_LINES = 50, LATEST_MS = 6000;
const camera = $("#camera canvas"), noCamera = $("#camera .empty"), pad = $("#pad");
const watch = new Watch(onNews, onPicture);
const box = new Box(camera);
const drive = new Drive({ onChange: drawSeat, onRefused: tell, onStop: stop });
const since = (ms) => seconds((performance.now() - ms) / 1000);

// -- updates -----------------------------------------------------------------------------------------------

const draws = {
  library: drawLibrary, job: drawJob, news: drawNews, taken: drawSeat,
  robot_id: (name) => say($("#robot"), name),
  health: (health) => {
    drawHealth(health);
    const told = (service) => health.services.find(({ name }) => name === service)?.told;
    if (told("robot")) drawWorlds(told("robot")), inWorld(told("robot").world);
    const disk = told("recorder")?.disk;
    say($("#disk"), disk ? `Recording: ${disk}` : "");
    $("#disk").hidden = !disk;
  },
};

function onNews(channels) {
  if (channels.length > 0 || !watch.connected) document.body.classList.add("told");
  for (const channel of channels) draws[channel]?.(watch.state[channel]);
  drawStatus();
  if (channels.some((one) => ["belief", "plan", "model"].includes(one))) drawBelief(watch.state, watch.age("belief"));
  if (channels.some((one) => ["pose", "way", "model", "belief", "tracked", "goal"].includes(one))) {
    drawMap(watch.state, (channel) => watch.age(channel));
  }
}

async function onPicture(blob) {
  const image = await createImageBitmap(blob), { width, height } = image;
  if (camera.width !== width || camera.height !== height) Object.assign(camera, { width, height });
  const pen = camera.getContext("2d");
  pen.drawImage(image, 0, 0);
  drawAhead(pen, watch.state, (channel) => watch.age(channel));
  box.draw(pen);
  image.close();
}

function status() {
  if (!watch.connected) return ["bad", `Not connected to the console for ${since(watch.sinceMs)}`];
  if (watch.silence > NO_WORD_S) return ["bad", `The console has been silent for ${seconds(watch.silence)}`];
  return robotStatus(watch.state, { age: watch.age("robot"), sits: drive.sits, opening: drive.sits && opening() });
}

let waitingSinceMs = 0;

function drawStatus() {
  const [how, text] = status(), pill = $("#status"), { robot } = watch.state, running = Boolean(robot?.episode);
  pill.className = `pill ${how}`;
  say(pill, text);
  pill.title = text;  // full text of a truncated pill
  $("#stop").setAttribute("aria-pressed", String(Boolean(robot?.emergency || robot?.cause === "emergency_stop")));
  if (running && document.body.dataset.episode !== robot.episode) showNews("");
  document.body.dataset.episode = robot?.episode ?? "";
  document.body.dataset.outcome = robot?.outcome ?? "";
  for (const id of ["found", "end"]) $(`#${id}`).disabled = !running;
  say($("#episode"), episodeFacts(robot));
  drawCameraAge(running, Boolean(robot?.waiting));
}

function drawCameraAge(running, waits) {
  const age = watch.age("camera"), opens = drive.sits && opening(), ill = illness(watch.state.health);
  if (!waits) waitingSinceMs = performance.now();
  $("#withdraw").hidden = !waits || !drive.sits;
  noCamera.hidden = !waits && age !== null && (age < OLD_S || !running);
  if (noCamera.hidden) return;
  const what = opens ? `The robot opens ${opens}, which may take a minute` : "Waiting for the robot";
  if (waits) say(noCamera, `${what}: ${since(waitingSinceMs)}`);
  else if (age === null) say(noCamera, "No camera frame yet. Begin a drive or a run.");
  else say(noCamera, `No camera frame for ${seconds(age)}${ill && `: ${ill}`}`);
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
  $("#latest").hidden = false;
  showLatest.timer = setTimeout(() => ($("#latest").hidden = true), LATEST_MS);
}

function stop() {
  if (![watch.stop(), drive.stop()].includes(true)) tell("NOT SENT: not connected to the console.");
  else if (watch.silence > NO_WORD_S) tell("The console does not answer: the emergency stop may be late.");
}

$("#stop").onclick = stop;
$("#seat").onclick = () => (drive.sits ? drive.leave() : drive.take());
const asks = {
  resume: { do: "resume" }, end: { do: "end", found: false }, withdraw: { do: "withdraw" },
};
for (const id in asks) $(`#${id}`).onclick = () => drive.ask(asks[id]);
$("#found").onclick = () => (drive.ask({ do: "end", found: true, box: box.drawn }), box.clear());
wireTeaching((what) => {
  drive.ask(what);
  if (["drive", "run"].includes(what.do)) $("#camera").scrollIntoView({ block: "start" });
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
