// The robot on the map of a simulated world: a person carries it elsewhere by mouse, finger, pen or keys.

import { $, say } from "./element.js";
import { wireMapKeys } from "./map_keys.js";

// The robot follows the hand as a trailer follows its hitch, so it faces where it was pulled.
const BAR_PX = 24, CLICK_PX = 4;
const button = $("#carry"), canvas = $("#map canvas"), state = $("#map-state");

let shown = null, hand = null;

/** Robot in the hand, as pixel and heading on the map that it was taken from; null if the hand is empty. */
export const inHand = () => hand;

/** Follow the robot that the map shows: `pixel`, heading, and the transform; null if it cannot be carried. */
export function followRobot(robot) {
  shown = robot;
  if (!robot && hand) letGo();
  button.hidden = !robot;
  const at = hand ?? robot;
  if (at) button.style.translate = at.pixel.map((one) => `${one}px`).join(" ");
}

function take(pointer = null) {
  const { pixel: [x, y], heading, view } = shown;
  const tail = [x - BAR_PX * Math.cos(heading), y + BAR_PX * Math.sin(heading)];
  hand = { pixel: [x, y], heading, view, tail, pointer, moved: false };
  button.setAttribute("aria-pressed", "true");
}

function pull([x, y]) {
  const [ahead, down] = [x - hand.tail[0], y - hand.tail[1]], length = Math.hypot(ahead, down);
  if (length > 0) {
    hand.heading = Math.atan2(-down, ahead);
    hand.tail = [x - (BAR_PX * ahead) / length, y - (BAR_PX * down) / length];
  }
  hand.pixel = [x, y];
  hand.moved = true;
}

function letGo() {
  const { pixel, heading, view } = hand;
  hand = null;
  button.setAttribute("aria-pressed", "false");
  say(state, "");
  return { pixel, heading, at: view.from(pixel) };
}

/** Connect the robot's button: `carry` receives metres and heading, `click` the pixel of a click, `tell` a line of news. */
export function wireCarry({ carry, redraw, click, tell }) {
  const put = () => {
    const { pixel: [x, y], heading, at } = letGo();
    const inside = x >= 0 && y >= 0 && x <= canvas.clientWidth && y <= canvas.clientHeight;
    if (inside) carry({ x_m: at[0], y_m: at[1], heading_rad: heading });
    else tell("Not carried: drop the robot on the map.");
    redraw();
  };
  const back = () => {
    if (hand) letGo();
    redraw();
  };
  button.onmousedown = (event) => event.preventDefault();  // keys stay with driving
  button.onpointerdown = (event) => {
    if (event.button !== 0 || !shown) return;
    button.setPointerCapture(event.pointerId);
    take([event.clientX - shown.pixel[0], event.clientY - shown.pixel[1]]);
  };
  button.onpointermove = ({ clientX, clientY }) => {
    if (!hand?.pointer) return;
    const to = [clientX - hand.pointer[0], clientY - hand.pointer[1]];
    if (!hand.moved && Math.hypot(to[0] - hand.pixel[0], to[1] - hand.pixel[1]) < CLICK_PX) return;
    pull(to);
    redraw();
  };
  button.onpointerup = () => {
    if (!hand?.pointer) return;
    if (hand.moved) return put();
    click(hand.pixel);
    back();
  };
  button.onpointercancel = () => hand?.pointer && back();
  addEventListener("resize", () => hand && back());
  button.onblur = () => hand && !hand.pointer && back();
  const held = () => {
    say(state, "In your hand: the arrow keys move the robot, Enter puts it down, Escape cancels.");
    redraw();
  };
  wireMapKeys(button, {
    active: () => hand,
    move: (by) => {
      pull(hand.pixel.map((one, axis) => one + by[axis]));
      held();
    },
    enter: () => {
      if (hand) return put();
      take();
      held();
    },
    cancel: back,
  });
}
