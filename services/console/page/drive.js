// Driving. The console sends a beat 20 times a second, and each is answered with what is held: no answer, no movement.

const KEYS = {
  KeyW: "forward", KeyA: "left", KeyS: "backward", KeyD: "right",
  ArrowUp: "forward", ArrowLeft: "left", ArrowDown: "backward", ArrowRight: "right",
};
/** Linear and angular velocity: shares of the robot's own. */
const VELOCITIES = { forward: [1, 0], backward: [-1, 0], left: [0, 1], right: [0, -1] };
const together = (atoms) => [0, 1].map((axis) => [...atoms].reduce((sum, atom) => sum + VELOCITIES[atom][axis], 0));
const TAKEN = 4002;
const DEAD_ZONE = 0.15, GAMEPAD_STOP = 1;  // A worn stick stands as far from its middle.
const GAMEPAD_PAD = { 12: "forward", 13: "backward", 14: "left", 15: "right" };
const TYPED_IN = "input:not([type=checkbox], [type=file]), select, textarea";

export class Drive {
  constructor({ onChange, onRefused, onStop }) {
    this.sits = false;
    this.word = "";  // shows that the seat is ours, to what is sent otherwise than by its socket
    this._held = new Set();
    this._beat = null;
    this._onChange = onChange;
    this._onRefused = onRefused;
    this._onStop = onStop;
    addEventListener("keydown", (event) => this._key(event, true));
    addEventListener("keyup", (event) => this._key(event, false));
    // While a menu is open or something is dragged, no page hears that a key is let go.
    for (const lost of ["blur", "pagehide", "contextmenu", "dragstart"]) {
      addEventListener(lost, (event) => event.defaultPrevented || this.letGo());
    }
    document.addEventListener("visibilitychange", () => this._visibility());
  }

  /** The velocity that is asked for: of all keys that are held, or of a gamepad; null where nothing is held. */
  get held() {
    const pad = this._gamepad();  // looked at first, always: it may stop
    return this._held.size ? together(this._held) : pad;
  }

  /** Sit down; resolves to whether the seat was free. */
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
        const lost = this.sits ? "You lost the connection: the robot stands." : "";
        this._onRefused(code === TAKEN ? "Somebody else drives; you watch." : lost);
        this._sit(false, done);
      };
    });
    return this._taking;
  }

  /** Stand up in good order; the robot does not miss who did. */
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

  /** Whether an emergency stop could be sent. */
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
    if (sits && document.hidden) this._visibility();  // it was hidden before the seat was ours
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
    if (event.metaKey || event.key === "Meta") return this.letGo();  // macOS tells of no other key's release then
    const atom = KEYS[event.code];
    const types = event.target instanceof Element && event.target.closest(TYPED_IN);
    if (!atom || (down && (types || event.ctrlKey || event.altKey))) return;
    if (this.sits && down) event.preventDefault();
    if (down && event.repeat) return;
    if (down && !this.sits) return this._onRefused("Take control first, then drive.");
    down ? this.press(atom) : this.release(atom);
  }

  /** Nobody drives in a page that nobody sees. */
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
    this._stops = stops;  // before it is told: who is told asks what is held
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
