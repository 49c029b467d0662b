// The map: taught drives, today's path, the robot, and its estimated position.

import { followRobot, inHand } from "./carry.js";
import { choosing, cornersOf } from "./choose.js";
import { course } from "./ahead.js";
import { $, cleared, color } from "./element.js";
import { teaching } from "./words.js";

const MARGIN = 18, NEAR_PX = 24, LEAST_M = 4, CROSS_PX = 6, STANDS_S = 5, CARRIED_M = 1.5, CARRIED_TIMES = 5, MOVES_M = 0.1;
const PLANNED_PX = [6, 5], MARK_PX = 9;
const ARROW_PX = [[10, 0], [-6, 6], [-3, 0], [-6, -6]];
const canvas = $("#map canvas"), place = $("#place"), legend = $("#map .legend"), guide = $("#map-state");

let shown = { places: [] }, plan = { layers: [] };

canvas.addEventListener("click", ({ offsetX, offsetY }) => choosing() || showPlace([offsetX, offsetY]));

/** Show the taught picture of the place at a pixel; a pixel elsewhere hides it. */
export function showPlace([left, top]) {
  const off = shown.places.map(([x, y]) => Math.hypot(x - left, y - top)), key = off.indexOf(Math.min(...off));
  place.hidden = !(off[key] <= NEAR_PX);
  if (place.hidden) return;
  place.src = `taught/${shown.model.id}/${key}`;
  place.alt = `Taught picture, ${shown.model.along[key].toFixed(1)} m along the way`;
}

/** Double the area that points enclose; negative if they run clockwise. */
function area2(points) {
  return points.reduce((sum, [x, y], k) => {
    const [beforeX, beforeY] = points.at(k - 1);
    return sum + beforeX * y - x * beforeY;
  }, 0);
}

/** Paths of a ground plan in metres, a path for consecutive shapes of a kind: later shapes cover earlier shapes. */
function layersOf(ground) {
  if (plan.ground === ground) return plan.layers;
  plan = { ground, layers: [] };
  for (const { kind, points, filled } of ground?.shapes ?? []) {
    let layer = plan.layers.at(-1);
    if (layer?.kind !== kind || layer.filled !== filled) {
      layer = { kind, filled, path: new Path2D() };
      plan.layers.push(layer);
    }
    // In a common path, outlines that overlap in opposite directions leave a hole.
    const turned = area2(points) < 0 ? [...points].reverse() : points;
    turned.forEach((point, k) => layer.path[k ? "lineTo" : "moveTo"](...point));
  }
  return plan.layers;
}

/** Pieces of a path between which the robot was carried: a step is then far longer than the others. */
function pieces(path) {
  const steps = path.slice(1).map(([x, y], k) => Math.hypot(x - path[k][0], y - path[k][1]));
  const moving = steps.filter((step) => step >= MOVES_M).sort((a, b) => a - b);
  const far = Math.max(CARRIED_M, CARRIED_TIMES * (moving[moving.length >> 1] ?? 0));
  const ends = [...steps.flatMap((step, k) => (step > far ? [k + 1] : [])), path.length];
  return ends.map((end, k) => path.slice(ends[k - 1] ?? 0, end));
}

/** Transform between metres and the pixels of a map that shows all points below `top`: `at`, its inverse `from`, the scale. */
function viewOf(points, [width, height], top) {
  const spans = [0, 1].map((axis) => {
    const values = points.map((point) => point[axis]);
    return [Math.min(...values), Math.max(...values)];
  });
  const [middleX, middleY] = spans.map(([low, high]) => (low + high) / 2);
  const room = [width, height - top].map((pixels) => pixels - 2 * MARGIN), middle = (height + top) / 2;
  const scale = Math.min(...spans.map(([low, high], axis) => room[axis] / Math.max(high - low, LEAST_M)));
  const at = ([x, y]) => [width / 2 + (x - middleX) * scale, middle - (y - middleY) * scale];
  const from = ([x, y]) => [middleX + (x - width / 2) / scale, middleY - (y - middle) / scale];
  return { at, from, scale };
}

/**
 * Draw the ground plan, boxes, taught drives, a path, a planned way and the goal, scaled to all points and `others`, or by a
 * given `view`. The upper `top` pixels stay free. Returns the view, and functions that draw more: `beside`, the pixel at an offset in pixels ahead and to the left of a pose; `trace`, a line through
 * pixels, or its interior; `arrow`, a robot; `mark`, a square at a place; and the pixels of the taught places. Null without a point.
 */
export function drawPlaces(pen, size, { ground, boxes = [], taught, drives = [], path, planned = [], victim, others = [], view, top = 0 }) {
  const all = [...taught, ...path, ...planned, ...others, ...(victim ? [victim] : [])];
  // The ground plan alone shows the task; a town is far larger than a way.
  if (ground) all.push(ground.start, ground.victim);
  if (all.length === 0) return null;
  view ??= viewOf(all, size, top);
  const { at, scale } = view;
  const beside = ([x, y, heading], [ahead, left]) => {
    const [px, py] = at([x, y]), [cos, sin] = [Math.cos(heading), Math.sin(heading)];
    return [px + cos * ahead - sin * left, py - sin * ahead - cos * left];
  };
  const trace = (pixels, shade, thickness, { closed = false, filled = false } = {}) => {
    const path = new Path2D();
    pixels.forEach((pixel, k) => path[k ? "lineTo" : "moveTo"](...pixel));
    if (closed) path.closePath();
    Object.assign(pen, { strokeStyle: color(shade), fillStyle: color(shade), lineWidth: thickness, lineJoin: "round" });
    filled ? pen.fill(path) : pen.stroke(path);
  };
  const arrow = (pose, shade, filled) =>
    trace(ARROW_PX.map((corner) => beside(pose, corner)), shade, 2, { closed: true, filled });
  const cross = ([x, y]) => {
    for (const rise of [-CROSS_PX, CROSS_PX]) trace([[x - CROSS_PX, y - rise], [x + CROSS_PX, y + rise]], "bad", 3);
  };
  pen.save();
  pen.translate(...at([0, 0]));
  pen.scale(scale, -scale);
  for (const { kind, filled, path } of layersOf(ground)) {
    Object.assign(pen, { strokeStyle: color(kind), fillStyle: color(kind), lineWidth: 1 / scale, lineJoin: "round" });
    filled ? pen.fill(path) : pen.stroke(path);
  }
  pen.restore();
  for (const box of boxes) trace(box.map(at), "box", 1, { filled: true });
  for (const drive of new Set(taught.length > 0 ? drives : [])) {
    const points = taught.filter((_, k) => drives[k] === drive).map(at);
    trace(points, "taught", 3);
    pen.beginPath();
    pen.arc(...points.at(-1), 6, 0, 7);
    pen.fill();
  }
  for (const piece of pieces(path)) trace(piece.map(at), "way", 2);
  const mark = (place, shade) => {
    const [x, y] = at(place);
    pen.fillStyle = color(shade);
    pen.fillRect(x - MARK_PX / 2, y - MARK_PX / 2, MARK_PX, MARK_PX);
  };
  if (planned.length > 0) {
    pen.setLineDash(PLANNED_PX);
    trace(planned.map(at), "soft", 2);
    pen.setLineDash([]);
    mark(planned[0], "soft");
  }
  if (victim) cross(at(victim));
  return { view, beside, trace, arrow, mark, places: taught.map(at) };
}

/** Places of an episode for `drawPlaces`, without its path; drives in another world have no position in this world. */
export function placesOf({ model, robot, goal, ground }, episode) {
  const elsewhere = Boolean(model?.world && robot?.world && model.world !== robot.world) || teaching(robot);
  const { at = null, boxes = [] } = goal && goal.episode === episode ? goal : {};
  const taught = model?.x && !elsewhere ? model.x.map((x, k) => [x, model.y[k]]) : [];
  return { ground, taught, drives: model?.drives, victim: at, boxes };
}

/** True pose of a simulated robot: of the running episode, else where it stands. */
function truePose({ robot, pose, stands }, age) {
  const [channel, now] = robot?.episode ? ["pose", pose] : ["stands", stands];
  if (now && age(channel) < STANDS_S) return now.pose;
  return pose && age("pose") < STANDS_S ? pose.pose : null;
}

/** Draw the map; `carries` whether a person can carry the robot. */
export function drawMap(state, age, carries) {
  const { model, way, pose, tracked, belief, around, robot, health } = state;
  const height = canvas.clientHeight, [pen, width] = cleared(canvas, height);
  const today = way && pose && way.episode === pose.episode ? [...way.points, pose.pose] : pose ? [pose.pose] : [];
  const places = placesOf(state, pose?.episode);
  const begins = !robot?.episode || teaching(robot), planned = (begins && places.ground?.route) || [];
  if (!robot?.episode) places.victim = planned.at(-1) ?? null;
  const believed = age("belief") < 2 && places.taught.length > 0 ? belief?.pose : undefined;
  legend.querySelector(".victim").classList.toggle("absent", !places.victim);
  const truth = truePose(state, age), hand = inHand();
  const choice = choosing(), corners = choice && places.ground ? cornersOf(places.ground) : [];
  const others = [believed, truth, ...corners].filter(Boolean);
  const top = choice ? guide.clientHeight : legend.clientHeight, view = hand?.view ?? choice?.view;
  const drawn = drawPlaces(pen, [width, height], { ...places, path: today, planned, others, top, view });
  $("#map").classList.toggle("nothing", !drawn);
  followRobot(drawn && truth && carries && !choice ? { pixel: drawn.view.at(truth), heading: truth[2], view: drawn.view } : null);
  if (!drawn) return;
  const { view: { scale, from }, beside, trace, arrow, mark } = drawn;
  if (choice) choice.view = drawn.view;
  for (const picked of choice?.picked ?? []) mark(picked, "accent");
  shown = { model, places: drawn.places };
  const here = truth ?? believed;
  pen.fillStyle = color("bad");
  const there = (metres) => beside(here, metres.map((one) => one * scale));
  for (const metres of (here && age("around") < 1 && around?.things) || []) {
    const [x, y] = there(metres);
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  if (here) trace(course({ robot, health }).map(there), "good", 3);
  if (tracked && age("tracked") < 2) arrow(tracked.pose, "soft", false);
  if (truth) arrow(truth, "good", !hand);
  if (hand) arrow([...from(hand.pixel), hand.heading], "good", true);
  if (believed) arrow(believed, "believed", false);
}
