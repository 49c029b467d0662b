// Texts about the robot.

export const OUTCOMES = {
  found: "found", collision: "collision", timeout: "out of time", aborted: "ended before the goal",
  false_goal: "it reported “found”, wrongly", missed: "it passed the goal without a report",
  not_here: "it reported “not here”",
};
/** Outcome of an episode, and whether the robot's report was right. */
const ended = ({ outcome, right }) => OUTCOMES[outcome] + ({ true: ", rightly", false: ", wrongly" }[right] ?? "");
export const DOES = {
  forward: "drives forward", backward: "drives backward", left: "turns left", right: "turns right", stop: "stands",
};
const PLANS = {
  follow: "follows the taught way", action: "does the action of its state", goal: "has reported what it found",
  dead_end: "has no route from here", look_around: "looks around", guess: "drives by its best guess",
  blind: "stands: its camera shows nothing that was taught",
  blocked: "waits: an obstacle blocks the way, and there is no way round it",
  stop: "stops: it is lost", search: "has arrived, and searches for the target",
};
const CAUSES = {
  not_armed: "The robot is not armed: a drive or a run arms it",
  emergency_stop: "EMERGENCY STOP: the robot stands until you press “Arm, resume”",
  operator_lost: "The robot stands: it lost its operator for a moment. Press “Arm, resume”",
  wheels: "The robot stands: its odometry contradicts the commands. Look at its wheels, then press “Arm, resume”",
  fault: "The robot stands: its body has failed. Look at it, then press “Arm, resume”",
};
const CAMERAS = {
  blank: "The camera shows nothing: its picture has no texture.",
  frozen: "Camera frozen: its picture stays the same while the wheels move.",
};
const DRIVERS = { teleop: "A person drives", policy: "The robot drives by itself", expert: "The expert drives" };
const SILENT_S = 2;

export function seconds(s) {
  if (s >= 120) return `${Math.round(s / 60)} min`;
  return s < 10 ? `${s.toFixed(1)} s` : `${Math.round(s)} s`;
}

export const percent = (share) => `${Math.round(100 * share)} %`;

/** Ailments of the needed services; empty if all work. */
export function illness(health, needed = ["router", "robot"]) {
  const ill = health?.services.filter(({ name, ailment }) => ailment && needed.includes(name)) ?? [];
  return ill.map(({ name, ailment }) => `${name}: ${ailment}`).join(", ");
}

/** Status of the robot in one line with its level (good, warn, bad); `opening` is the world being opened. */
export function robotStatus({ robot, health, taken }, { age, sits, opening }) {
  if (!robot || (!robot.answers && !robot.waiting)) {
    const ill = illness(health);
    return ["bad", `The robot does not answer${["", "robot: does not answer"].includes(ill) ? "" : `: ${ill}`}`];
  }
  if (robot.emergency || robot.cause === "emergency_stop") return ["bad", CAUSES.emergency_stop];
  if (robot.waiting) return ["warn", `Waiting for the robot${opening ? ` to open ${opening}` : ""} …`];
  if (robot.cause) return [robot.cause === "not_armed" ? "warn" : "bad", CAUSES[robot.cause]];
  const last = robot.outcome ? `. The last ${robot.purpose}: ${ended(robot)}` : "";
  if (!robot.episode) return ["good", `Armed${last}`];
  if (age > SILENT_S) return ["bad", `No sign of the robot for ${seconds(age)}`];
  if (robot.reason === "taken_over") {
    return ["warn", "A person has taken over: drive on, or press “Arm, resume”, and the robot goes on by itself"];
  }
  if (robot.reason === "silence") {
    const free = taken ? "the driver holds no key" : "take control, then hold a key to drive";
    const why = sits ? "hold a key to drive" : free;
    return ["warn", `The robot stands: ${robot.driver === "teleop" ? why : "it receives no command"}`];
  }
  if (robot.reason === "deaf") {
    return ["bad", "The robot stands: its link to the router is down; it goes on when the link is back"];
  }
  if (robot.reason === "obstacle") {
    const again = robot.source === "teleop" && sits ? ". To go on slowly all the same, let go, and hold the key again" : "";
    return ["warn", `It stands or drives slower: there is an obstacle, or the way is not known to be free${again}`];
  }
  if (robot.reason === "no_depth") {
    return ["bad", "The robot stands: its depth camera shows no ground, is frozen, or is too late"];
  }
  if (robot.reason === "insisted") return ["warn", "There is an obstacle: it goes on slowly, since you insist"];
  if (robot.reason === "radius") return ["good", "A car turns while it drives, no more sharply than it can"];
  const correct = robot.source === "policy" && sits ? "; hold a key to correct it" : "";
  return ["good", `${DRIVERS[robot.source] ?? "The robot stands"}${correct}`];
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
  const end = robot.outcome ? `, ${ended(robot)}` : "";
  return `${robot.purpose === "run" ? "Run" : "Drive"} to ${robot.goal} in ${robot.world}: frame ${robot.tick}${now}${end}`;
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

/** Description of a recording, or the reason why it cannot teach. */
export function recordingFacts(one, when) {
  if (one.useless) return one.useless;
  const end = `${OUTCOMES[one.outcome] ?? "end not recorded"}${one.corrected ? ", corrected by hand" : ""}`;
  return `${end}, ${one.world}, ${Math.round(one.seconds)} s, ${one.frames} frames, ${when}`;
}
