// The header: the step, one sentence, and the next actions, all derived from one state.

import { CAUSES, MISSED, OUTCOMES, REASONS, seconds, tooSlow } from "./words.js";

const SILENT_S = 2, SETTLED_S = 5, SLOW = 0.8;
const TEACH = "Drive to the goal once; then the robot finds the way by itself";
const FOUND = { true: ", rightly", false: ", wrongly" };

/** Alarms of the link and the robot; they precede everything else. */
function alarm({ link, silence, robot, age, ill, simulated }) {
  if (link) return ["bad", link];
  if (silence) return ["bad", `The console has been silent for ${seconds(silence)}`];
  if (robot?.waiting) return null;
  const silent = age === null ? "" : ` for ${seconds(age)}`;
  if (!robot?.answers) return ["old", `The robot does not answer${silent}${ill && `: ${ill}`}`];
  if (robot.emergency) return ["bad", CAUSES.emergency_stop];
  if (robot.episode && age > SILENT_S) return ["old", `No sign of the robot${silent}`];
  // A drive or a run arms the robot, so between episodes only real trouble counts.
  const idle = !robot.episode && ["not_armed", "operator_lost"].includes(robot.cause);
  if (!robot.cause || idle) return null;
  if (robot.cause === "operator_lost" && simulated) return ["warn", MISSED];
  return [robot.cause === "not_armed" ? "warn" : "bad", CAUSES[robot.cause]];
}

/** A sentence about a running episode. */
function running({ robot, sits, taken, simulated, frames_hz }) {
  const hand = robot.driver === "teleop", reason = REASONS[robot.reason];
  const time = robot.seconds === null ? "" : ` (${seconds(robot.seconds)})`;
  if (robot.reason === "silence" && hand) {
    return ["good", sits ? `Drive to ${robot.goal}: hold a key or the pad${time}`
      : taken ? "The driver holds no key" : "Take control, then hold a key to drive"];
  }
  if (reason) return reason;
  const rate = robot.seconds > SETTLED_S ? robot.tick / robot.seconds : frames_hz;
  if (simulated && rate < SLOW * frames_hz) return ["warn", tooSlow(rate, frames_hz)];
  const correct = sits ? "; hold a key to correct it" : "";
  if (hand) return ["good", `Drive to ${robot.goal}, then press “Found”${time}`];
  if (robot.source === "policy") return ["good", `The robot drives to ${robot.goal} by itself${time}${correct}`];
  return ["good", `${robot.source ? "A person drives" : "The robot stands"}${time}`];
}

/** The outcome of the last episode; empty without one. */
function outcome({ robot, distance }) {
  if (!robot?.outcome) return "";
  const told = [distance === null ? "" : `${distance.toFixed(1)} m`, robot.seconds === null ? "" : seconds(robot.seconds)];
  const facts = told.filter(Boolean).join(", "), words = OUTCOMES[robot.outcome] + (FOUND[robot.right] ?? "");
  const what = robot.purpose === "run" || robot.outcome !== "found" ? words : "you reached the goal";
  return what[0].toUpperCase() + what.slice(1) + (facts && `: ${facts}`);
}

/** Actions of a running episode, the main one first. */
function during({ robot, sits }, stopped) {
  const ends = robot.driver === "teleop" || robot.reason === "taken_over" || robot.source === "teleop";
  const end = ends ? ["found", "end"] : ["end", "found"];
  return stopped || robot.reason === "taken_over" ? ["resume", ...end] : end;
}

/**
 * The header as { step, level, text, does }: `does` names the actions, the next one first.
 * `step` is the chosen step; without one it follows from the state.
 */
export function lead(state) {
  const { robot, job, chosen, drives, untaught, models } = state;
  const problem = alarm(state);
  if (robot?.waiting && !problem) {
    const step = robot.purpose === "run" ? "run" : "teach";
    return { step: chosen ?? step, level: "warn", text: `${state.opening || "The robot begins"} …`, does: ["withdraw"] };
  }
  if (robot?.episode) {
    const [level, text] = problem ?? running(state);
    const does = during(state, Boolean(robot.cause || robot.emergency));
    return { step: robot.purpose === "run" ? "run" : "teach", level, text, does };
  }
  const learns = job?.kind === "model" && !job.outcome, failed = job?.kind === "model" && job.outcome === "failed";
  const drove = robot?.outcome === "found" && robot.purpose === "drive";
  const next = learns || (drove && !models) || untaught ? "learn" : models ? "run" : drives ? "learn" : "teach";
  const step = chosen ?? next;
  const does = [learns && step === "learn" ? "cancel" : { teach: "drive", learn: "learn", run: "run" }[step]];
  if (problem) return { step, level: problem[0], text: problem[1], does: robot?.emergency || robot?.cause ? ["resume", ...does] : does };
  if (learns) return { step, level: "good", text: job.text, does };
  if (failed && job.fresh) return { step, level: "bad", text: `${job.text}. Select other drives, or begin a new one`, does };
  const then = { teach: TEACH, learn: "Now let it learn the way", run: "Now let it find the way by itself" }[step];
  const ended = outcome(state);
  const good = !ended || ["found", "not_here"].includes(robot.outcome) && robot.right !== false;
  return { step, level: good ? "good" : "warn", text: [ended, robot?.purpose === "run" && ended && step === "run" ? "" : then].filter(Boolean).join(". "), does };
}
