// Texts about the robot.

const coarse = matchMedia("(pointer: coarse)");
/** Control that a person holds to drive: a finger has no keys. */
export const control = () => (coarse.matches ? "the arrow pad" : "a key");
/** Request for a click on the map. */
export const clickOn = (place) =>
  coarse.matches ? `Tap ${place} on the map.` : `Click ${place} on the map. By keys: arrows, Enter; Escape cancels.`;

export const DOES = {
  forward: "drives forward", backward: "drives backward", left: "turns left", right: "turns right", stop: "stands",
};
export const PLANS = {
  follow: "follows the taught way", action: "does the action of its state", goal: "has reported what it found",
  dead_end: "has no route from here", look_around: "looks around", guess: "drives by its best guess",
  blind: "stands: its camera shows nothing that was taught",
  blocked: "waits: an obstacle blocks the way, and there is no way round it",
  stop: "stops: it is lost", search: "has arrived, and searches for the target",
};
export const CAUSES = {
  not_armed: "The robot stands until you press “Resume”",
  emergency_stop: "Emergency stop: the robot stands until you press “Resume”",
  operator_lost: "The robot stands: it lost its operator for a moment. Press “Resume”",
  wheels: "The robot stands: its odometry contradicts the commands. Look at its wheels, then press “Resume”",
  fault: "The robot stands: its body has failed. Look at it, then press “Resume”",
};
export const MISSED = "It stands: this computer was busy. Drive on, or press “Resume”";
export const LEFT = "The robot stands: its driver has left. Press “Resume” to continue";
/** Why the robot does not follow its driver, with the level of the sentence. */
export const REASONS = {
  taken_over: ["warn", "You drive: press “Resume”, and the robot goes on by itself"],
  silence: ["warn", "The robot stands: it receives no command"],
  deaf: ["bad", "The robot stands: its link to the router is down; it goes on when the link is back"],
  obstacle: ["warn", "An obstacle: to go on slowly all the same, let go, and drive on"],
  no_depth: ["bad", "The robot stands: its depth camera shows no ground, is frozen, or is too late"],
  insisted: ["warn", "There is an obstacle: it goes on slowly, since you insist"],
};
export const HELD_UP = "An obstacle slows down or stops the robot";
export const tooSlow = (rate, wanted) =>
  `This computer is too slow for real time (${Math.round(rate)} of ${Math.round(wanted)} frames a second)`;
export const LABELS = {
  drive: "Begin a drive", learn: "Learn", run: "Run", found: "Found: end here", end: "Give up", quit: "End the run",
  resume: "Resume", withdraw: "Cancel", cancel: "Cancel learning",
};
const CAMERAS = {
  blank: "The camera shows nothing: its picture has no texture.",
  frozen: "Camera frozen: its picture stays the same while the wheels move.",
};

export function seconds(s) {
  if (s >= 120) return `${Math.round(s / 60)} min`;
  return s < 10 ? `${s.toFixed(1)} s` : `${Math.round(s)} s`;
}

export const percent = (share) => `${Math.round(100 * share)} %`;

/** Ailments of router and robot; empty if both work. */
export function illness(health) {
  const ill = health?.services.filter(({ name, ailment }) => ailment && ["router", "robot"].includes(name)) ?? [];
  return ill.map(({ name, ailment }) => `${name}: ${ailment}`).join(", ");
}

/** Description of a velocity; slight bends count as straight. */
function does({ atom, linear, angular }) {
  const bends = linear && Math.abs(angular) >= 0.1 ? `, bending ${angular > 0 ? "left" : "right"}` : "";
  return bends ? DOES[linear > 0 ? "forward" : "backward"] + bends : DOES[atom] ?? DOES.stop;
}

/** Progress of the episode, or outcome of the last episode. */
export function episodeFacts(robot) {
  if (!robot?.purpose) return "";
  const now = robot.episode ? `, it ${does(robot)}` : "";
  const end = robot.outcome ? `, ${robot.result}` : "";
  const frames = robot.tick + 1;  // the first frame has tick 0
  return `${robot.purpose === "run" ? "Run" : "Drive"} to ${robot.goal} in ${robot.world}: ${frames} frames${now}${end}`;
}

/** Description of the belief; `age` in seconds. */
export function beliefFacts(belief, age) {
  if (!belief) return "Nothing yet: begin a run.";
  if (age >= 2) return `This is ${seconds(age)} old.`;
  const { status, keyframe, lost, sure, state, gap, camera, pitch } = belief;
  if (CAMERAS[camera]) return CAMERAS[camera];
  if (status === "unknown") return `Lost${keyframe === undefined ? "" : ` (${percent(lost)})`}: no taught place matches.`;
  const changed = pitch ? ` Its camera points ${Math.abs(pitch)}° ${pitch > 0 ? "down" : "up"} from the taught direction; views are corrected.` : "";
  if (keyframe !== undefined) return `The robot is ${percent(sure)} sure of this place, and ${percent(lost)} lost.${changed}`;
  if (Number.isInteger(state)) return `The paper's scheme: state ${state}, duality gap ${gap.toExponential(0)}.`;
  return status === "recognized" ? "The page reads the model …" : "The robot has not recognized a taught place yet.";
}

/** Address of a recording's report. */
export const reportOf = (recording) => `report?${new URLSearchParams({ of: recording })}`;

/** How often the robot was carried elsewhere; empty if never. */
export const kidnappings = (count) => (count ? `kidnapped${count > 1 ? ` ${count} times` : ""}` : "");

/** Numbers of a finished run: `metres` driven, `s` seconds, `off` metres to the goal, if known, and kidnappings. */
export function finishFacts({ metres, s, off, kidnapped }) {
  const driven = metres === null ? "" : `${metres.toFixed(1)} m driven`, took = s === null ? "" : `in ${seconds(s)}`;
  return [`${driven} ${took}`.trim(), off === null ? "" : `${off.toFixed(1)} m from the goal`, kidnappings(kidnapped)].filter(Boolean).join(", ");
}

/** Rows of the plan: action, commands, remaining time, target. */
export function planFacts(plan, belief, goal) {
  const cost = belief.cost === null ? "no way to the goal" : `${belief.cost?.toFixed(0)} s to ${goal}`;
  return {
    Plan: plan ? PLANS[plan.kind] : "–",
    Now: plan ? plan.atoms.slice(0, 3).map((atom) => DOES[atom]).join(", ") : "–",
    "To go": belief.cost === undefined ? "–" : cost,
    Seen: Number.isFinite(belief.seen) ? percent(belief.seen) : "–",
  };
}

/** Numbers of a running job. */
export function jobFacts({ stage, share, left_s }) {
  const numbers = [share === null ? "" : percent(share), left_s ? `some ${seconds(left_s)} left` : ""];
  return [stage, numbers.filter(Boolean).join(", ")].filter(Boolean).join(": ");
}

/** Activity of a job, or its result. */
export const jobText = ({ name, doing, done, outcome, why }) =>
  ({ done, cancelled: `${name} was cancelled.`, failed: `${doing} failed: ${why}` })[outcome] ?? `${doing} …`;

/** Description of a recording, or the reason why it cannot teach. */
export function recordingFacts(one, when) {
  if (one.useless) return one.useless;
  const end = `${one.result}${one.corrected ? ", corrected by hand" : ""}`;
  return `${end}, ${one.world}, ${seconds(one.seconds)}, ${one.frames} frames, ${when}`;
}

/** Whether a person teaches now: then an earlier model's belief and plan have no meaning. */
export const teaching = (robot) => Boolean(robot?.episode) && robot.purpose === "drive";

/** A text with a capital letter. */
export const capital = (text) => text[0].toUpperCase() + text.slice(1);
