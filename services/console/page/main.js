// The page: what is heard is drawn, what is pressed is said.

import { drawBelief } from "./belief.js";
import { Drive } from "./drive.js";
import { $, element, say, seconds } from "./element.js";
import { drawHealth, illness } from "./health.js";
import { drawMap } from "./map.js";
import { drawJob, drawLibrary, inWorld, OUTCOMES, wireTeaching } from "./teach.js";
import { Watch } from "./watch.js";
import { drawWorlds, hideNews, opening, wireWorlds } from "./world.js";

const OLD_S = 1, SILENT_S = 2, NO_WORD_S = 3, MOST_LINES = 50, LATEST_MS = 6000;
const CAUSES = {
  not_armed: "Not armed: a drive or a run arms it",
  emergency_stop: "EMERGENCY STOP: it stands until you press “Arm, resume”",
  operator_lost: "It stands: it lost its operator for a moment. Press “Arm, resume”",
  fault: "It stands: its body has failed. Look at it, then press “Arm, resume”",
};
const BY = { teleop: "Driven by hand", policy: "Drives by itself", expert: "Driven by the expert" };
const DOING = { forward: "drives forward", backward: "drives backward", left: "turns left", right: "turns right", stop: "stands" };

const camera = $("#camera canvas"), noCamera = $("#camera .empty"), pad = $("#pad");
const watch = new Watch(onNews, onPicture);
const drive = new Drive({ onChange: drawSeat, onRefused: tell, onStop: stop });

// -- what is heard ---------------------------------------------------------------------------------------------------

const draws = {
  library: () => drawLibrary(watch.state.library),
  health: () => {
    drawHealth(watch.state.health);
    const told = watch.state.health.services.find(({ name }) => name === "robot")?.told;
    if (told) drawWorlds(told), inWorld(told.world);
    const disk = watch.state.health.services.find(({ name }) => name === "recorder")?.told?.disk;
    say($("#disk"), disk ? `Recording: ${disk}` : "");
    $("#disk").hidden = !disk;
  },
  job: () => drawJob(watch.state.job),
  news: () => drawNews(watch.state.news),
  robot_id: () => say($("#robot"), watch.state.robot_id),
  taken: drawSeat,
};

function onNews(channels) {
  if (channels.length > 0 || !watch.connected) document.body.classList.add("told");
  for (const channel of channels) draws[channel]?.();
  drawStatus();
  if (channels.some((one) => ["belief", "plan", "model"].includes(one))) drawBelief(watch.state, (channel) => watch.age(channel));
  if (channels.some((one) => ["pose", "way", "model", "belief", "tracked", "goal"].includes(one))) drawMap(watch.state, (channel) => watch.age(channel));
}

async function onPicture(blob) {
  const image = await createImageBitmap(blob);
  if (camera.width !== image.width || camera.height !== image.height) [camera.width, camera.height] = [image.width, image.height];
  camera.getContext("2d").drawImage(image, 0, 0);
  image.close();
}

/** How the robot is, in one line, and whether that is good, a warning or bad. */
function status() {
  const { robot } = watch.state, ill = illness(watch.state.health, ["router", "robot"]);
  if (!watch.connected) return ["bad", `No connection to the console for ${seconds((performance.now() - watch.sinceMs) / 1000)}`];
  if (watch.silence > NO_WORD_S) return ["bad", `No word from the console for ${seconds(watch.silence)}`];
  if (!robot || (!robot.answers && !robot.waiting)) return ["bad", ["The robot does not answer", ...(ill === "" || ill === "robot: does not answer" ? [] : [ill])].join(": ")];
  if (robot.emergency || robot.cause === "emergency_stop") return ["bad", CAUSES.emergency_stop];
  if (robot.waiting) return ["warn", `Waiting for the robot${drive.sits && opening() ? ` to open ${opening()}` : ""} …`];
  if (robot.cause) return [robot.cause === "not_armed" ? "warn" : "bad", CAUSES[robot.cause]];
  if (!robot.episode) return ["good", robot.outcome ? `Armed; the last ${robot.purpose}: ${OUTCOMES[robot.outcome] ?? robot.outcome}` : "Armed"];
  if (watch.age("robot") > SILENT_S) return ["bad", `No sign of the robot for ${seconds(watch.age("robot"))}`];
  if (robot.reason === "taken_over") return ["warn", "It stands: taken over by hand. Drive on, or press “Arm, resume” and it goes on by itself"];
  if (robot.reason === "silence") return ["warn", robot.driver !== "teleop" ? "It stands: no command has come" : drive.sits ? "It stands: hold a key to drive" : watch.state.taken ? "It stands: who drives holds no key" : "It stands: take control, and hold a key to drive"];
  return ["good", `${BY[robot.source] ?? "It stands"}${robot.source === "policy" && drive.sits ? "; hold a key to correct it" : ""}`];
}

let waitingSinceMs = 0;

function drawStatus() {
  if (!watch.state.robot?.waiting) waitingSinceMs = performance.now();
  const [how, text] = status(), pill = $("#status"), { robot } = watch.state;
  pill.className = `pill ${how}`;
  say(pill, text);
  pill.title = text;  // where it is cut off
  $("#stop").setAttribute("aria-pressed", String(Boolean(robot?.emergency || robot?.cause === "emergency_stop")));
  const running = Boolean(robot?.episode);
  if (running && document.body.dataset.episode !== robot.episode) hideNews();
  document.body.dataset.episode = robot?.episode ?? "";
  document.body.dataset.outcome = robot?.outcome ?? "";
  for (const id of ["found", "end"]) $(`#${id}`).disabled = !running;
  say($("#episode"), !robot?.purpose ? "" : `${robot.purpose === "run" ? "Run" : "Drive"} to ${robot.goal} in ${robot.world}: frame ${robot.tick}${robot.episode ? `, it ${DOING[robot.atom] ?? "stands"}` : ""}${robot.outcome ? `, ${OUTCOMES[robot.outcome] ?? robot.outcome}` : ""}`);
  drawCameraAge(running);
}

function drawCameraAge(running) {
  const age = watch.age("camera"), waits = Boolean(watch.state.robot?.waiting);
  $("#withdraw").hidden = !waits || !drive.sits;
  noCamera.hidden = !waits && age !== null && (age < OLD_S || !running);
  if (waits) say(noCamera, `${drive.sits && opening() ? `Opening ${opening()}, which may take a minute` : "Waiting for the robot"}: ${seconds((performance.now() - waitingSinceMs) / 1000)}`);
  else if (age === null) say(noCamera, "No camera frame yet. Begin a drive or a run.");
  else if (!noCamera.hidden) say(noCamera, `No camera frame for ${seconds(age)}${illness(watch.state.health, ["router", "robot"]).replace(/^(?=.)/, ": ")}`);
}

let lastLine = 0;

/** Add what is new, and no more: a screen reader reads out what is added. */
function drawNews(lines) {
  if (lines.at(-1).number < lastLine) lastLine = 0; // the console was started again
  for (const { number, at, text } of lines.filter(({ number }) => number > lastLine)) {
    tell(text, new Date(Date.now() - 1000 * watch.since(at)));
    lastLine = number;
  }
}

// -- what is pressed -------------------------------------------------------------------------------------------------

function drawSeat() {
  const seat = $("#seat"), taken = Boolean(watch?.state.taken) && !drive?.sits;
  seat.setAttribute("aria-pressed", String(Boolean(drive?.sits)));
  say(seat, drive?.sits ? "Leave control" : taken ? "Somebody else drives" : "Take control");
  const held = drive?.held;
  for (const button of pad.children) button.classList.toggle("held", button.dataset.atom === held);
}

function tell(text, when = new Date()) {
  const list = $("#news");
  if (text) list.prepend(element("li", {}, element("time", {}, when.toLocaleTimeString()), text));
  if (text && Date.now() - when < LATEST_MS) showLatest(text);
  if (list.children.length > MOST_LINES) list.lastChild.remove();
  $("#news-empty").hidden = list.children.length > 0;
}

/** The news may be out of sight: the latest is shown for a while wherever one has scrolled to. */
function showLatest(text) {
  clearTimeout(showLatest.timer);
  say($("#latest"), text);
  $("#latest").hidden = false;
  showLatest.timer = setTimeout(() => ($("#latest").hidden = true), LATEST_MS);
}

function stop() {
  if (![watch.stop(), drive.stop()].includes(true)) tell("NOT SENT: there is no connection to the console.");
  else if (watch.silence > NO_WORD_S) tell("The console does not answer: the emergency stop may be late.");
}

$("#stop").onclick = stop;
$("#seat").onclick = () => (drive.sits ? drive.leave() : drive.take());
$("#resume").onclick = () => drive.ask({ do: "resume" });
$("#found").onclick = () => drive.ask({ do: "end", found: true });
$("#withdraw").onclick = () => drive.ask({ do: "withdraw" });
$("#end").onclick = () => drive.ask({ do: "end", found: false });
wireTeaching((what) => {
  drive.ask(what);
  if (["drive", "run"].includes(what.do)) $("#camera").scrollIntoView({ block: "start" });  // what is to be looked at now
});
wireWorlds(async (map, name) => {
  if (!(await drive.take())) return;
  tell(`Sending ${map.name} …`);
  try {
    const answer = await fetch(`map?${new URLSearchParams({ name })}`, { method: "POST", headers: { "smal-seat": drive.word }, body: map });
    if (!answer.ok) tell(`${map.name}: ${await answer.text()}`);
  } catch (error) {
    tell(`${map.name} could not be sent: ${error.message}`);
  }
});

for (const button of pad.children) {
  const { atom } = button.dataset;
  const press = async () => (await drive.take()) && button.matches(":active") && drive.press(atom);
  button.onpointerdown = (event) => {
    button.setPointerCapture(event.pointerId);
    drive.sits ? drive.press(atom) : press();
  };
  for (const let_go of ["onpointerup", "onpointercancel", "onlostpointercapture", "onblur"]) button[let_go] = () => drive.release(atom);
  // Who returns false there keeps every key from what it does elsewhere, and Tab would not lead away.
  button.onkeydown = ({ code, repeat }) => { if (["Space", "Enter"].includes(code) && !repeat && drive.sits) drive.press(atom); };
  button.onkeyup = ({ code }) => { if (["Space", "Enter"].includes(code)) drive.release(atom); };
  button.oncontextmenu = (event) => event.preventDefault();
}
onNews(["belief", "pose"]);
setInterval(() => onNews(["belief", "pose"]), 500);
