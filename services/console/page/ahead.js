// Predicted course and obstacles, in metres ahead and to the left, and as overlay of the level camera's image.

import { color } from "./element.js";
import { percent, teaching } from "./words.js";

const COURSE_S = 3, TURN_S = 1, STEPS = 24, NEAREST_M = 0.1, SURE = 0.5;

/** Course of the next seconds as [ahead, left, direction]; a turn on the spot sweeps the direction of view. */
export function course({ robot, health }) {
  const told = health?.services.find(({ name }) => name === "robot")?.told ?? {};
  const { speed_m_s: speed, turn_rate_rad_s: rate } = told, { episode, linear, angular } = robot ?? {};
  if (!episode || !speed || !(linear || angular)) return [];
  return Array.from({ length: STEPS + 1 }, (_, k) => {
    const turned = (angular * rate * (linear ? COURSE_S : TURN_S) * k) / STEPS, reach = speed * COURSE_S;
    if (!linear) return [reach * Math.cos(turned), reach * Math.sin(turned), turned + Math.PI / 2];
    const chord = ((linear * reach * k) / STEPS) * (turned ? Math.sin(turned / 2) / (turned / 2) : 1);
    return [chord * Math.cos(turned / 2), chord * Math.sin(turned / 2), turned];
  });
}

/** Draw the overlay of the camera image; requires the mounting of a depth camera. */
export function drawAhead(pen, { around, belief, model, ...state }, age) {
  const { width, height } = pen.canvas, { mounting, columns, apart } = (age("around") < 1 && around) || {};
  if (mounting) {
    const { focal, height_m, ahead_m, radius_m } = mounting, across = (left) => width * (0.5 - focal * left);
    const down = (up_m, ahead) => height / 2 + (width * focal * (height_m - up_m)) / ahead;
    pen.fillStyle = color("over-bad");
    for (const [left, ahead, top] of columns) {
      const high = down(top, ahead);
      pen.fillRect(across(left + apart / 2), high, width * focal * apart, down(0, ahead) - high);
    }
    const seen = course(state).filter(([ahead]) => ahead - ahead_m > NEAREST_M);
    const side = (off) => seen.map(([x, y, turned]) => {
      const ahead = Math.max(x - ahead_m - off * Math.sin(turned), NEAREST_M);
      return [across((y + off * Math.cos(turned)) / ahead), down(0, ahead)];
    });
    pen.fillStyle = color("over-way");
    pen.beginPath();
    for (const corner of [...side(radius_m), ...side(-radius_m).reverse()]) pen.lineTo(...corner);
    pen.fill();
  }
  if (teaching(state.robot) || age("belief") >= 1 || !Number.isFinite(belief?.left) || !(belief.seen >= SURE)) return;
  const x = width * (0.5 - belief.left), size = width / 32;
  Object.assign(pen, { fillStyle: "#fff", font: `600 ${size}px system-ui, sans-serif`, textAlign: "center" });
  const text = `▼ ${model?.goal ?? "goal"}, ${percent(belief.seen)}`;
  Object.assign(pen, { strokeStyle: "#000", lineWidth: size / 5, lineJoin: "round" });
  pen.strokeText(text, x, 1.5 * size);
  pen.fillText(text, x, 1.5 * size);
}
