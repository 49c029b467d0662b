// Driving. The console sends 20 beats a second; the page answers each with the held velocity, else the robot stops.

const KEYS = {
  KeyW: "forward", KeyA: "left", KeyS: "backward", KeyD: "right",
  ArrowUp: "forward", ArrowLeft: "left", ArrowDown: "backward", ArrowRight: "right",
};
/** Linear and angular velocity, as fractions of the robot's nominal speeds. */
const VELOCITIES = { forward: [1, 0], backward: [-1, 0], left: [0, 1], right: [0, -1] };
const together = (atoms) => [0, 1].map((axis) => [...atoms].reduce((sum, atom) => sum + VELOCITIES[atom][axis], 0));
const TAKEN = 4002;
const DEAD_ZONE = 0.15, GAMEPAD_STOP = 1;  // Rest position of a worn stick.
const GAMEPAD_PAD = { 12: "forward", 13: "backward", 14: "left", 15: "right" };
const TYPED_IN = "input:not([type=checkbox], [type=file]), select, textarea";

export class Drive {
  constructor({ onChange, onRefused, onStop }) {
    this.sits = false;
    this.word = "";  // secret of the seat, for requests outside the socket
    this._held = new Set();
    this._beat = null;
    this._onChange = onChange;
    this._onRefused = onRefused;
    this._onStop = onStop;
    addEventListener("keydown", (event) => this._key(event, true));
    addEventListener("keyup", (event) => this._key(event, false));
    // Pages receive no key releases during a menu or a drag.
    for (const lost of ["blur", "pagehide", "contextmenu", "dragstart"]) {
      addEventListener(lost, (event) => event.defaultPrevented || this.letGo());
    }
    document.addEventListener("visibilitychange", () => this._visibility());
  }

  /** Commanded velocity of the held keys, else of a gamepad; null without input. */
  get held() {
    const pad = this._gamepad();  // always read first, for its stop button
    return this._held.size ? together(this._held) : pad;
  }

  /** Take the seat; resolves to whether it was free. */
  take() {
    if (this.sits) return Promise.resolve(true);
    this._taking ??= new Promise((done) => {
      const socket = (this._socket = new WebSocket(`${location.origin.replace("http", "ws")}/drive`));
      socket.onmessage = ({ data }) => {
        const { beat, refused, word } = JSON.parse(data);
        if (word) return (this.word = word);
        if (refused) return this._onRefused(refused);
        this._beat = beat;
        if (!this.sits) this._sit(true, done);
        this._answer();
      };
      socket.onclose = ({ code }) => {
        const lost = this.sits ? "Connection lost: the robot stops." : "";
        this._onRefused(code === TAKEN ? "Another person drives; you are watching." : lost);
        this._sit(false, done);
      };
    });
    return this._taking;
  }

  /** Leave the seat; the robot does not miss its driver. */
  leave() {
    if (!this.sits) return;
    this.letGo();
    this._send({ do: "leave" });
    this._socket.onclose = null;
    this._socket.close();
    this._sit(false, () => {});
  }

  async ask(what) {
    if (await this.take()) this._send({ ...what, beat: this._beat });
  }

  /** Send an emergency stop; returns whether it was sent. */
  stop() {
    this.letGo();
    if (this.sits) this._send({ do: "stop" });
    return this.sits;
  }

  press(atom) {
    this._held.add(atom);
    this._answer();
  }

  release(atom) {
    this._held.delete(atom);
    this._answer();
  }

  letGo() {
    this._held.clear();
    this._answer();
  }

  _sit(sits, done) {
    this.sits = sits;
    this._taking = sits ? this._taking : null;
    this._held.clear();
    done(sits);
    if (sits && document.hidden) this._visibility();  // hidden before the seat was taken
    this._onChange();
  }

  _answer() {
    if (this.sits) this._send({ do: "hold", beat: this._beat, held: this.held });
    this._onChange();
  }

  _send(what) {
    if (this._socket.readyState === WebSocket.OPEN) this._socket.send(JSON.stringify(what));
  }

  _key(event, down) {
    if (event.code === "Escape") return down && !event.repeat && this._onStop();
    if (event.metaKey || event.key === "Meta") return this.letGo();  // macOS sends no release of other keys then
    const atom = KEYS[event.code];
    const types = event.target instanceof Element && event.target.closest(TYPED_IN);
    if (!atom || (down && (types || event.ctrlKey || event.altKey))) return;
    if (this.sits && down) event.preventDefault();
    if (down && event.repeat) return;
    if (down && !this.sits) return this._onRefused("Take control first, then drive.");
    down ? this.press(atom) : this.release(atom);
  }

  /** Leave the seat while the page is hidden. */
  async _visibility() {
    if (document.hidden) {
      this._back = this.sits;
      this.leave();
    } else if (this._back) {
      await this.take();
    }
  }

  _gamepad() {
    const pads = [...navigator.getGamepads()].filter((pad) => pad && pad.connected !== false);
    const stops = pads.some((pad) => pad.buttons[GAMEPAD_STOP]?.pressed), pressed = stops && !this._stops;
    this._stops = stops;  // before the callback, which reads the held velocity
    if (pressed) this._onStop();
    if (stops || !document.hasFocus()) return null;
    for (const pad of pads) {
      const atoms = Object.keys(GAMEPAD_PAD).filter((button) => pad.buttons[button]?.pressed);
      if (atoms.length) return together(atoms.map((button) => GAMEPAD_PAD[button]));
      const [x = 0, y = 0] = pad.axes.map((a) => (Math.abs(a) < DEAD_ZONE ? 0 : Math.max(-1, Math.min(a, 1))));
      if (x || y) return [-y, -x];
    }
    return null;
  }
}
