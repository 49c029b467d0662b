// The map: taught drives, today's path, the robot, and its estimated position.

import { course } from "./ahead.js";
import { $, cleared, color } from "./element.js";
import { teaching } from "./words.js";

const MARGIN = 18, NEAR_PX = 24, LEAST_M = 4, CROSS_PX = 6;
const ARROW_PX = [[10, 0], [-6, 6], [-3, 0], [-6, -6]];
const canvas = $("#map canvas"), place = $("#place"), legend = $("#map .victim");

let shown = { places: [] };

/** Show the taught picture of the place at a click; a click elsewhere hides it. */
canvas.onclick = ({ offsetX, offsetY }) => {
  const off = shown.places.map(([x, y]) => Math.hypot(x - offsetX, y - offsetY)), key = off.indexOf(Math.min(...off));
  place.hidden = !(off[key] <= NEAR_PX);
  if (place.hidden) return;
  place.src = `taught/${shown.model.id}/${key}`;
  place.alt = `Taught picture, ${shown.model.along[key].toFixed(1)} m along the way`;
};

export function drawMap({ model, way, pose, tracked, belief, around, robot, health, goal, ground }, age) {
  const height = canvas.clientHeight, [pen, width] = cleared(canvas, height);
  // Drives in another world have no position in this world.
  const other = Boolean(model?.world && robot?.world && model.world !== robot.world), elsewhere = other || teaching(robot);
  const taught = model?.x && !elsewhere ? model.x.map((x, k) => [x, model.y[k]]) : [];
  const today = way && pose && way.episode === pose.episode ? [...way.points, pose.pose] : pose ? [pose.pose] : [];
  const believed = age("belief") < 2 && !elsewhere ? belief?.pose : undefined;
  const victim = goal?.at && goal.episode === robot?.episode ? goal.at : null;
  legend.classList.toggle("absent", !victim);
  const all = [...taught, ...today, ...(believed ? [believed] : []), ...(victim ? [victim] : [])];
  // The ground plan alone shows the task; a town is far larger than a way.
  if (ground) all.push(ground.start, ground.victim);
  $("#map").classList.toggle("nothing", all.length === 0);
  if (all.length === 0) return;
  const axes = [0, 1].map((axis) => all.map((point) => point[axis]));
  const spans = axes.map((values) => [Math.min(...values), Math.max(...values)]);
  const [middleX, middleY] = spans.map(([low, high]) => (low + high) / 2);
  const room = [width, height].map((pixels) => pixels - 2 * MARGIN);
  const scale = Math.min(...spans.map(([low, high], axis) => room[axis] / Math.max(high - low, LEAST_M)));
  const at = ([x, y]) => [width / 2 + (x - middleX) * scale, height / 2 - (y - middleY) * scale];
  /** Pixel at an offset in pixels, ahead and to the left of a pose. */
  const beside = ([x, y, heading], [ahead, left]) => {
    const [px, py] = at([x, y]), [cos, sin] = [Math.cos(heading), Math.sin(heading)];
    return [px + cos * ahead - sin * left, py - sin * ahead - cos * left];
  };

  /** Draw a line through pixels, or fill its interior. */
  const trace = (pixels, shade, thickness, { closed = false, filled = false } = {}) => {
    const path = new Path2D();
    pixels.forEach((pixel, k) => path[k ? "lineTo" : "moveTo"](...pixel));
    if (closed) path.closePath();
    Object.assign(pen, { strokeStyle: color(shade), fillStyle: color(shade), lineWidth: thickness, lineJoin: "round" });
    filled ? pen.fill(path) : pen.stroke(path);
  };
  for (const { kind, points, filled } of ground?.shapes ?? []) trace(points.map(at), kind, 1, { filled });
  for (const box of (goal?.episode === pose?.episode && goal?.boxes) || []) trace(box.map(at), "box", 1, { filled: true });
  const arrow = (pose, shade, filled) =>
    trace(ARROW_PX.map((corner) => beside(pose, corner)), shade, 2, { closed: true, filled });

  shown = { model, places: taught.map(at) };
  for (const drive of new Set(taught.length > 0 ? model.drives : [])) {
    const points = taught.filter((_, k) => model.drives[k] === drive).map(at);
    trace(points, "taught", 3);
    pen.beginPath();
    pen.arc(...points.at(-1), 6, 0, 7);
    pen.fill();
  }
  trace(today.map(at), "way", 2);
  if (victim) {
    const [x, y] = at(victim);
    for (const rise of [-CROSS_PX, CROSS_PX]) trace([[x - CROSS_PX, y - rise], [x + CROSS_PX, y + rise]], "bad", 3);
  }
  const here = pose && age("pose") < 5 ? pose.pose : believed;
  pen.fillStyle = color("bad");
  const there = (metres) => beside(here, metres.map((one) => one * scale));
  for (const metres of (here && age("around") < 1 && around?.things) || []) {
    const [x, y] = there(metres);
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  if (here) trace(course({ robot, health }).map(there), "good", 3);
  if (tracked && age("tracked") < 2) arrow(tracked.pose, "soft", false);
  if (pose && age("pose") < 5) arrow(pose.pose, "good", true);
  if (believed) arrow(believed, "believed", false);
}
