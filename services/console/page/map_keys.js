// Keys of a control on the map: arrows move something, Enter or space picks, Escape cancels.

const STEP_PX = 6;
const MOVES = { ArrowUp: [0, -1], ArrowDown: [0, 1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

/** Connect a control: `move` receives pixels; arrows and Escape count only while it is `active`. */
export function wireMapKeys(control, { active, move, enter, cancel }) {
  control.onkeydown = (event) => {
    const { key } = event, enters = key === "Enter" || key === " ";
    if (!enters && !(active() && (key in MOVES || key === "Escape"))) return;
    event.preventDefault();
    event.stopPropagation();  // these keys neither drive nor stop the robot
    if (key === "Escape") return cancel();
    if (key in MOVES) return move(MOVES[key].map((one) => STEP_PX * one));
    if (!event.repeat) enter();
  };
}
