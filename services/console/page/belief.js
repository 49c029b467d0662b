// Where the robot thinks it is: the belief over the taught frames, and the taught image that it matches.

import { $, cleared, color, element, percent, say, seconds } from "./element.js";

const BAR_PX = 4, HEIGHT = 64, LEAST = 0.01, DOES = { forward: "↑ forward", backward: "↓ backward", left: "← turn left", right: "→ turn right", stop: "■ stop" };
const WHY = {
  follow: "follows the taught way", action: "does the action of its state", goal: "has arrived", dead_end: "knows no way on",
  look_around: "looks around", guess: "drives by its best guess", stop: "stops: it does not know where it is",
};

const section = $("#belief");
const parts = { empty: section.querySelector(".empty"), content: section.querySelector(".content"), facts: section.querySelector(".facts") };
const strip = section.querySelector(".strip"), image = section.querySelector("img"), caption = section.querySelector("figcaption"), list = section.querySelector("dl");

let recognized = "";

export function drawBelief({ model, belief, plan }, age) {
  const known = model && !model.trouble && model.id;
  parts.content.hidden = !known;
  parts.empty.hidden = Boolean(known);
  if (!known) return say(parts.empty.querySelector("p"), model?.trouble ?? "No model is loaded.");
  const fresh = belief && age("belief") < 2;
  const lost = fresh && belief.status === "unknown";
  section.classList.toggle("lost", Boolean(lost));
  section.classList.toggle("old", !fresh);
  section.classList.toggle("nowhere", Boolean(fresh) && belief.keyframe === undefined);
  if (!fresh) recognized = "";
  else if (Number.isInteger(belief.state)) recognized = `The paper's scheme: state ${belief.state}, duality gap ${belief.gap.toExponential(0)}.`;
  say(parts.facts, !fresh ? (belief ? `As it was ${seconds(age("belief"))} ago.` : "It tells nothing before a run.") : belief.keyframe === undefined ? (belief.status === "unknown" ? "No taught place looks like this." : belief.status === "recognized" && !Number.isInteger(belief.state) ? "The model is being read …" : recognized || "No taught place is recognized yet.") : lost ? `Lost: ${percent(belief.lost)} sure that it is nowhere near.` : `${percent(belief.sure ?? 0)} sure of this place, ${percent(belief.lost)} lost.`);
  drawStrip(model, fresh ? belief : null);
  if (!fresh) return;
  const rows = { Plan: plan ? WHY[plan.kind] : "–", Now: plan ? plan.atoms.slice(0, 3).map((atom) => DOES[atom]).join(", ") : "–", "To go": belief.cost === undefined ? "–" : belief.cost === null ? "no way to the goal" : `${belief.cost.toFixed(0)} s to ${model.goal}` };
  if (list.children.length === 0) for (const name in rows) list.append(element("dt", {}, name), element("dd"));
  Object.values(rows).forEach((text, k) => say(list.children[2 * k + 1], text));
  const key = belief.keyframe;
  if (key === undefined) return;
  const source = `taught/${model.id}/${key}`;
  if (image.getAttribute("src") !== source) image.setAttribute("src", source);
  image.alt = `The taught image that the view matches, ${model.along[key]} m along the way`;
  say(caption, `The taught image that it matches, ${model.along[key].toFixed(1)} m along drive ${model.drives[key] + 1}; cosine ${belief.cosine.toFixed(2)}${belief.gap ? `, duality gap ${belief.gap.toExponential(0)}` : ""}.`);
}

/** One track a drive, as long as its way; a bar is the belief on that stretch. */
function drawStrip(model, belief) {
  const [pen, width] = cleared(strip, HEIGHT);
  const drives = Math.max(...model.drives) + 1, room = HEIGHT / drives, longest = Math.max(...model.along, 1e-9);
  pen.fillStyle = color("track");
  for (let drive = 0; drive < drives; drive++) {
    const length = Math.max(...model.along.filter((_, k) => model.drives[k] === drive));
    pen.fillRect(0, (drive + 1) * room - 5, (width * length) / longest, 4);
  }
  if (!belief) return;
  const bars = new Map();
  for (const [key, weight] of belief.places) {
    const at = `${model.drives[key]} ${Math.min(Math.floor((model.along[key] / longest) * width / BAR_PX), Math.floor(width / BAR_PX) - 1)}`;
    bars.set(at, (bars.get(at) ?? 0) + weight * (1 - belief.lost));
  }
  pen.fillStyle = color(belief.status === "unknown" ? "bad" : "accent");
  for (const [at, weight] of bars) {
    if (weight < LEAST) continue;
    const [drive, bar] = at.split(" ").map(Number), height = Math.max(2, weight * (room - 8));
    pen.fillRect(bar * BAR_PX, (drive + 1) * room - 5 - height, BAR_PX - 1, height);
  }
}
