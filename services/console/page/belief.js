// The robot's belief over the taught frames, and the best matching taught image.

import { $, cleared, color, element, say } from "./element.js";
import { beliefFacts, planFacts, teaching } from "./words.js";

const BAR_PX = 4, HEIGHT = 64, LEAST = 0.01;
const section = $("#belief"), strip = $("#belief .strip"), image = $("#belief img"), list = $("#belief dl");
// Models without recordings have no images.
image.onload = image.onerror = ({ type }) => image.classList.toggle("none", type === "error");

export function drawBelief({ model, belief, plan, robot }, age) {
  section.hidden = teaching(robot) || !(model?.trouble || (model?.id && belief));
  if (section.hidden) return;
  section.classList.toggle("troubled", Boolean(model.trouble));
  if (model.trouble) return say($("#belief .facts"), model.trouble);
  const fresh = Boolean(belief) && age < 2, key = belief?.keyframe;
  section.classList.toggle("old", !fresh);
  section.classList.toggle("nowhere", fresh && key === undefined);
  say($("#belief .facts"), beliefFacts(belief, age));
  drawStrip(model, fresh ? belief : null);
  if (!fresh) return;
  const rows = planFacts(plan, belief, model.goal);
  if (list.children.length === 0) for (const name in rows) list.append(element("dt", {}, name), element("dd"));
  Object.values(rows).forEach((text, k) => say(list.children[2 * k + 1], text));
  if (key === undefined) return;
  const source = `taught/${model.id}/${key}`, along = model.along[key].toFixed(1);
  if (image.getAttribute("src") !== source) image.setAttribute("src", source);
  image.alt = `The taught image that the view matches, ${along} m along the way`;
  const alike = `cosine ${belief.cosine.toFixed(2)}${belief.gap ? `, duality gap ${belief.gap.toExponential(0)}` : ""}`;
  const where = `${along} m along drive ${model.drives[key] + 1}`;
  say($("#belief figcaption"), `The view matches this taught image, ${where}; ${alike}.`);
}

/** Draw a track for each drive, proportional to its length; a bar is the belief on a stretch. */
function drawStrip({ drives, along }, belief) {
  const [pen, width] = cleared(strip, HEIGHT);
  const room = HEIGHT / (Math.max(...drives) + 1), longest = Math.max(...along, 1e-9);
  const place = (drive, from, to, height) => pen.fillRect(from, (drive + 1) * room - 5 - height, to - from, height);
  pen.fillStyle = color("track");
  for (const drive of new Set(drives)) {
    place(drive, 0, (width * Math.max(...along.filter((_, k) => drives[k] === drive))) / longest, -4);
  }
  if (!belief) return;
  const bars = {};
  for (const [key, weight] of belief.places) {
    const bar = Math.min(Math.floor(((along[key] / longest) * width) / BAR_PX), Math.floor(width / BAR_PX) - 1);
    const known = (bars[`${drives[key]} ${bar}`] ??= { drive: drives[key], bar, weight: 0 });
    known.weight += weight * (1 - belief.lost);
  }
  pen.fillStyle = color(belief.status === "unknown" ? "bad" : "accent");
  for (const { drive, bar, weight } of Object.values(bars)) {
    if (weight >= LEAST) place(drive, bar * BAR_PX, (bar + 1) * BAR_PX - 1, Math.max(2, weight * (room - 8)));
  }
}
