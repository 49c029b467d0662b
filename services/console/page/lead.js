// The header: the step, one sentence, and the next actions, all derived from one state.

import { CAUSES, HELD_UP, LEFT, MISSED, PLANS, REASONS, capital, control, jobFacts, jobText, seconds, tooSlow } from "./words.js";

const SILENT_S = 2, SETTLED_S = 5, SLOW = 0.8, STEADY_MS = 1000;
/** Action that begins each step. */
const BEGINS = { teach: "drive", learn: "learn", run: "run" };
/** Plans of a robot that does not get on by itself. */
const STUCK = ["blind", "blocked", "dead_end", "stop"];
const GUIDE = {
  teach: "Drive to the goal once; then the robot finds the way by itself",
  learn: "Now let the robot learn the way",
  run: "Now let the robot find the way by itself",
};

const learning = (job) => job?.kind === "model" && !job.outcome;

/** Trouble of the link or the robot, as [level, text]; it precedes everything else. */
function trouble({ link, robot, age, ill, unattended, sits, taken }) {
  if (link) return ["bad", link];
  if (robot?.waiting) return null;
  const silent = age === null ? "" : ` for ${seconds(age)}`;
  if (!robot?.answers) return ["old", `The robot does not answer${silent}${ill ? `: ${ill}` : ""}`];
  if (robot.emergency) return ["bad", CAUSES.emergency_stop];
  if (robot.episode && age > SILENT_S) return ["old", `No sign of the robot${silent}`];
  if (unattended && robot.cause === "operator_lost") {
    return robot.episode ? ["warn", sits || taken ? MISSED : LEFT] : null;
  }
  // A drive or a run arms the robot, so between episodes these stops are no trouble.
  const releases = !robot.episode && ["not_armed", "operator_lost"].includes(robot.cause);
  return robot.cause && !releases ? ["bad", CAUSES[robot.cause]] : null;
}

/** Sentence about the running episode, as [level, text]. */
function now({ robot, sits, taken, unattended, frames_hz, plan }) {
  const hand = robot.driver === "teleop", rate = robot.rate_hz;
  const stands = hand && robot.reason === "silence";
  const correct = sits ? `; hold ${control()} to correct it` : "";
  if (robot.source === "policy" && robot.reason === "obstacle") return ["warn", `${HELD_UP}${correct}`];
  if (REASONS[robot.reason] && !stands) return REASONS[robot.reason];
  if (robot.source === "policy" && STUCK.includes(plan)) return ["warn", `The robot ${PLANS[plan]}${correct}`];
  if (unattended && robot.seconds > SETTLED_S && rate !== null && rate < SLOW * frames_hz) return ["warn", tooSlow(rate, frames_hz)];
  if (hand && sits) return ["good", `Drive to ${robot.goal}, then press “Found”`];
  if (stands) return ["warn", taken ? "The driver lets the robot stand" : `Take control, then hold ${control()} to drive`];
  if (robot.source === "policy") return ["good", `The robot drives to ${robot.goal} by itself${correct}`];
  return ["good", robot.source ? "A person drives" : "The robot stands"];
}

/** Result of the last episode in one sentence; empty without one. */
function result({ robot, distance }) {
  if (!robot?.outcome) return "";
  const taught = robot.purpose === "drive" && robot.outcome === "found";
  const what = taught ? "you reached the goal" : robot.result;
  const metres = taught || distance === null ? [] : [`${distance.toFixed(1)} m from the goal`];
  const numbers = [...metres, ...(robot.seconds === null ? [] : [seconds(robot.seconds)])].join(", ");
  return capital(what) + (numbers && `: ${numbers}`);
}

/** Actions during an episode, the next one first. */
function during({ driver, source, reason, cause, emergency }) {
  const byHand = driver === "teleop" || reason === "taken_over" || source === "teleop";
  const ends = byHand ? ["found", "end"] : ["quit", "found"];
  return cause || emergency || reason === "taken_over" ? ["resume", ...ends] : ends;
}

/** Next step: what runs now, else what the newest drive and model still need. */
function nextStep({ robot, job, drives, untaught, unlisted, models }) {
  if (robot?.episode) return robot.purpose === "run" ? "run" : "teach";
  if (job?.kind === "model" && job.outcome === "done") return "run";  // the list follows
  const drove = robot?.purpose === "drive" && robot.outcome === "found" && (!models || unlisted);
  if (learning(job) || untaught || drove) return "learn";
  if (models) return "run";
  return drives ? "learn" : "teach";
}

/** Sentence between episodes, as [level, text, facts]. */
function between(state, step) {
  const { robot, job, refused } = state;
  if (refused) return ["warn", capital(refused)];
  if (learning(job)) return ["good", jobText(job), jobFacts(job)];
  if (job?.kind === "model" && job.outcome === "failed") {
    return ["bad", `${jobText(job)}. Select other drives below, or teach again`];
  }
  const ended = result(state), ran = ended && robot.purpose === "run";
  const good = !ended || (["found", "not_here"].includes(robot.outcome) && robot.right !== false);
  return [good ? "good" : "warn", ran ? ended : [ended, GUIDE[step]].filter(Boolean).join(". ")];
}

/**
 * Derive the header from the whole state: the next step, the shown step (`chosen`, if any), one
 * sentence with its level, its running numbers, and the actions, the next one first.
 */
export function lead(state) {
  const { robot, job, chosen } = state, next = nextStep(state), wrong = trouble(state);
  const step = robot?.episode ? next : chosen ?? next;
  if (robot?.waiting) {
    const [level, text] = wrong ?? ["warn", `${state.opening ? `The robot opens ${state.opening}` : "Waiting for the robot"} …`];
    return { next, step, level, text, facts: "", does: ["withdraw"] };
  }
  if (robot?.episode) {
    const [level, text] = wrong ?? now(state);
    const time = robot.seconds === null ? "" : seconds(robot.seconds);
    return { next, step, level, text, facts: time, does: during(robot) };
  }
  const [level, text, facts = ""] = wrong ?? between(state, step);
  const stopped = robot?.emergency || ["emergency_stop", "wheels", "fault"].includes(robot?.cause);
  const begin = learning(job) && step === "learn" ? "cancel" : BEGINS[step];
  return { next, step, level, text, facts, does: stopped ? ["resume"] : [begin] };
}

/**
 * Sentences of a running episode, as [level, text]: each is shown once it has held for a second, since
 * the robot's reason can change with each frame. Alarms begin and end at once.
 */
export class Steady {
  constructor() {
    this._shown = [];
    this._text = this._episode = "";
    this._sinceMs = 0;
  }

  show(level, text, episode, nowMs) {
    if (text !== this._text) [this._text, this._sinceMs] = [text, nowMs];
    const calm = [level, this._shown[0]].every((one) => ["good", "warn"].includes(one));
    const waits = calm && episode && episode === this._episode && nowMs - this._sinceMs < STEADY_MS;
    if (!waits) [this._shown, this._episode] = [[level, text], episode];
    return this._shown;
  }
}
