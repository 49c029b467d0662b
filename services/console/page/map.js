// The map: taught drives, today's way, the robot, and where it thinks that it is.

import { $, cleared, color } from "./element.js";

const HEIGHT = 220, MARGIN = 18, LEAST_M = 4;
const canvas = $("#map canvas"), legend = $("#map .victim");

export function drawMap({ model, way, pose, tracked, belief, plan, robot, goal }, age) {
  const [pen, width] = cleared(canvas, HEIGHT);
  // What was taught in another world is nowhere in this one.
  const elsewhere = Boolean(model?.world && robot?.world && model.world !== robot.world);
  const taught = model?.x && !elsewhere ? model.x.map((x, k) => [x, model.y[k]]) : [];
  const today = way && pose && way.episode === pose.episode ? [...way.points, pose.pose] : pose ? [pose.pose] : [];
  const believed = age("belief") < 2 && !elsewhere ? belief?.pose : undefined;
  const victim = goal?.at && goal.episode === robot?.episode ? goal.at : null;
  legend.classList.toggle("absent", !victim);
  const all = [...taught, ...today, ...(believed ? [believed] : []), ...(victim ? [victim] : [])];
  if (all.length === 0) {
    pen.fillStyle = color("soft");
    pen.font = "14px system-ui, sans-serif";
    return pen.fillText("Nothing to draw yet.", MARGIN, HEIGHT / 2);
  }
  const axes = [0, 1].map((axis) => all.map((point) => point[axis]));
  const spans = axes.map((values) => [Math.min(...values), Math.max(...values)]);
  const [middleX, middleY] = spans.map(([low, high]) => (low + high) / 2);
  const room = [width, HEIGHT].map((pixels) => pixels - 2 * MARGIN);
  const scale = Math.min(...spans.map(([low, high], axis) => room[axis] / Math.max(high - low, LEAST_M)));
  const at = ([x, y]) => [width / 2 + (x - middleX) * scale, HEIGHT / 2 - (y - middleY) * scale];

  const line = (points, shade, thickness) => {
    pen.beginPath();
    points.forEach((point, k) => pen[k ? "lineTo" : "moveTo"](...at(point)));
    [pen.strokeStyle, pen.lineWidth, pen.lineJoin] = [color(shade), thickness, "round"];
    pen.stroke();
  };
  const arrow = ([x, y, heading], shade, filled) => {
    const [px, py] = at([x, y]);
    pen.save();
    pen.translate(px, py);
    pen.rotate(-heading);
    pen.beginPath();
    [[10, 0], [-6, 6], [-3, 0], [-6, -6]].forEach((point, k) => pen[k ? "lineTo" : "moveTo"](...point));
    pen.closePath();
    [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [color(shade), color(shade), 2];
    filled ? pen.fill() : pen.stroke();
    pen.restore();
  };

  for (const drive of new Set(taught.length > 0 ? model.drives : [])) {
    const points = taught.filter((_, k) => model.drives[k] === drive);
    line(points, "taught", 3);
    const [gx, gy] = at(points.at(-1));
    pen.beginPath();
    pen.arc(gx, gy, 6, 0, 7);
    pen.fillStyle = color("taught");
    pen.fill();
  }
  line(today, "way", 2);
  if (victim) {
    const [vx, vy] = at(victim), half = 6;
    for (const rise of [-half, half]) {
      pen.beginPath();
      pen.moveTo(vx - half, vy - rise);
      pen.lineTo(vx + half, vy + rise);
      [pen.strokeStyle, pen.lineWidth] = [color("bad"), 3];
      pen.stroke();
    }
  }
  const [x, y, heading] = (pose && age("pose") < 5 ? pose.pose : believed) ?? [];
  pen.fillStyle = color("bad");
  for (const [ahead, left] of x !== undefined && plan && age("plan") < 1 ? plan.obstacles : []) {
    const [cos, sin] = [Math.cos(heading), Math.sin(heading)];
    const [px, py] = at([x + cos * ahead - sin * left, y + sin * ahead + cos * left]);
    pen.fillRect(px - 1, py - 1, 2, 2);
  }
  if (tracked && age("tracked") < 2) arrow(tracked.pose, "soft", false);
  if (pose && age("pose") < 5) arrow(pose.pose, "good", true);
  if (believed) arrow(believed, "believed", false);
}
