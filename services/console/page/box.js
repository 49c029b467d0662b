// The box that a person may draw about what they found, in the camera's picture, before they say so.

import { color } from "./element.js";

const LEAST = 0.05;  // Of the picture's width and height, as the console takes it.

export class Box {
  constructor(canvas) {
    this.drawn = null;  // left, top, right, bottom: shares of the picture's width and height
    let from = null;
    const at = ({ offsetX, offsetY }) => {
      const { width, height, clientWidth, clientHeight } = canvas;
      const scale = Math.min(clientWidth / width, clientHeight / height);  // it is shown whole, in the middle
      return [[offsetX, clientWidth, width], [offsetY, clientHeight, height]].map(
        ([off, shown, size]) => Math.max(0, Math.min((off - shown / 2) / (scale * size) + 0.5, 1)),
      );
    };
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      from = at(event);
      this.clear();
    };
    canvas.onpointermove = (event) => {
      if (!from) return;
      const [[left, right], [top, bottom]] = at(event).map((to, axis) => [from[axis], to].sort((a, b) => a - b));
      if (right - left >= LEAST && bottom - top >= LEAST) this.drawn = [left, top, right, bottom];
    };
    for (const ended of ["onpointerup", "onpointercancel"]) canvas[ended] = () => (from = null);
  }

  clear() {
    this.drawn = null;
  }

  draw(pen) {
    if (!this.drawn) return;
    const { width, height } = pen.canvas, [left, top, right, bottom] = this.drawn;
    Object.assign(pen, { strokeStyle: color("over-way"), lineWidth: width / 200 });
    pen.strokeRect(left * width, top * height, (right - left) * width, (bottom - top) * height);
  }
}
