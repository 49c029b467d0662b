// Receives updates. The server sends the next after an acknowledgement, so slow pages receive fewer.

const FIRST_WAIT_MS = 300, LONGEST_WAIT_MS = 3000;

export class Watch {
  constructor(onNews, onPicture) {
    this.state = {};
    this.connected = false;
    this.sinceMs = performance.now();
    this._askedMs = null;
    this._onNews = onNews;
    this._onPicture = onPicture;
    this._behindS = 0;
    this._waitMs = FIRST_WAIT_MS;
    this._open();
  }

  /** Seconds since a time of the console's clock. */
  since(at) {
    return Math.max(0, performance.now() / 1000 + this._behindS - at);
  }

  /** Age of a channel in seconds; null before its first update. */
  age(channel) {
    const at = this.state[channel]?.at ?? null;
    return at === null ? null : this.since(at);
  }

  /** Seconds since the last update, which normally arrives every two seconds. */
  get silence() {
    return this._askedMs === null ? 0 : (performance.now() - this._askedMs) / 1000;
  }

  /** Send an emergency stop; returns whether it was sent. */
  stop() {
    if (this.connected) this._socket.send('{"do":"stop"}');
    return this.connected;
  }

  _open() {
    const socket = (this._socket = new WebSocket(`${location.origin.replace("http", "ws")}/watch`));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this._connection(true);
    socket.onmessage = ({ data }) => {
      typeof data === "string" ? this._take(JSON.parse(data), socket) : this._show(data, socket);
    };
    socket.onclose = () => {
      this._connection(false);
      setTimeout(() => this._open(), this._waitMs);
      this._waitMs = Math.min(2 * this._waitMs, LONGEST_WAIT_MS);
    };
  }

  _connection(is) {
    if (is) [this._waitMs, this.state] = [FIRST_WAIT_MS, {}];
    if (is !== this.connected) this.sinceMs = performance.now();
    this.connected = is;
    this._askedMs = is ? performance.now() : null;
    this._onNews([]);
  }

  _take({ now, picture, ...news }, socket) {
    this._askedMs = picture ? performance.now() : null;
    this._behindS = now - performance.now() / 1000;
    Object.assign(this.state, news);
    try {
      this._onNews(Object.keys(news));
    } finally {  // acknowledge even after a drawing error; a following picture is acknowledged separately
      if (!picture) this._seen(socket);
    }
  }

  async _show(data, socket) {
    this._askedMs = null;
    try {
      await this._onPicture(new Blob([data], { type: "image/jpeg" }));
    } finally {
      this._seen(socket);
    }
  }

  /** Pause updates while the page is hidden. */
  _seen(socket) {
    requestAnimationFrame(() => {
      if (socket.readyState !== WebSocket.OPEN) return;
      socket.send('{"do":"seen"}');
      this._askedMs = performance.now();
    });
  }
}
