// The box that an operator can draw around the goal in the camera image before pressing Found.

import { color } from "./element.js";

const LEAST = 0.05;  // Minimum side of a box, as a share of the image's width or height.

export class Box {
  constructor(canvas) {
    this.drawn = null;  // left, top, right, bottom: fractions of the image's width and height
    let from = null;
    const at = ({ offsetX, offsetY }) => {
      const { width, height, clientWidth, clientHeight } = canvas;
      const scale = Math.min(clientWidth / width, clientHeight / height);  // object-fit: contain, centred
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
