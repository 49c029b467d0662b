// Choosing start and goal of a simulated world on the map, by clicks, or by a crosshair that keys move.

import { $, say } from "./element.js";
import { wireMapKeys } from "./map_keys.js";
import { clickOn } from "./words.js";

const NEAR_M = 60, NEAR_TIMES = 1.5;
const WANTED = ["the start", "the goal"];
const aim = $("#aim"), canvas = $("#map canvas"), state = $("#map-state"), button = $("#choose");

let choice = null;

/** The choice that is being made: the picked places in metres, the crosshair's pixel, and the map's view; else null. */
export const choosing = () => choice;

/** Corners of the ground plan about its task: a town is far larger than a way. */
export function cornersOf({ shapes, start, victim }) {
  const middle = [0, 1].map((axis) => (start[axis] + victim[axis]) / 2);
  const reach = Math.max(NEAR_M, NEAR_TIMES * Math.hypot(start[0] - victim[0], start[1] - victim[1]));
  const near = shapes.flatMap(({ points }) => points).filter(([x, y]) => Math.hypot(x - middle[0], y - middle[1]) <= reach);
  if (near.length === 0) return [];
  return [Math.min, Math.max].map((most) => [0, 1].map((axis) => near.reduce((far, point) => most(far, point[axis]), near[0][axis])));
}

function ask() {
  const where = WANTED[choice.picked.length];
  say(state, clickOn(where));
  aim.setAttribute("aria-label", `Cross: choose ${where}`);
  aim.style.translate = choice.aim.map((one) => `${one}px`).join(" ");
}

function end() {
  choice = null;
  aim.hidden = true;
  say(state, "");
}

/** End the choice while the robot cannot take it. */
export function drawChoice(possible) {
  button.disabled = !possible;
  if (!possible && choice) end();
}

/** Connect the controls: `enlarge` shows the large map, `chosen` receives start and goal, `redraw` draws the map. */
export function wireChoice({ enlarge, chosen, redraw }) {
  const pick = (pixel) => {
    choice.picked.push(choice.view.from(pixel));
    if (choice.picked.length < WANTED.length) ask();
    else {
      const [start, goal] = choice.picked;
      end();
      chosen({ start, goal });
    }
    redraw();
  };
  const cancel = () => {
    if (choice) end();
    redraw();
  };
  button.onclick = () => {
    enlarge();
    choice = { picked: [], aim: [canvas.clientWidth / 2, canvas.clientHeight / 2], view: null };
    aim.hidden = false;
    ask();
    redraw();
    aim.focus({ preventScroll: true });
    canvas.scrollIntoView({ block: "nearest" });
  };
  canvas.onmousedown = (event) => choice && event.preventDefault();  // the cross keeps the keys
  canvas.addEventListener("click", ({ offsetX, offsetY }) => choice && pick([offsetX, offsetY]));
  aim.onblur = cancel;
  addEventListener("resize", () => choice && cancel());
  wireMapKeys(aim, {
    active: () => choice,
    move: (by) => {
      const sides = [canvas.clientWidth, canvas.clientHeight];
      choice.aim = choice.aim.map((one, axis) => Math.max(0, Math.min(one + by[axis], sides[axis])));
      ask();
    },
    enter: () => choice && pick(choice.aim),
    cancel,
  });
}
