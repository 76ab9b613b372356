// The connection to the server. It comes back by itself, and says what it is doing.

import { offered } from "./word.js";

const FIRST_WAIT_MS = 200, LONGEST_WAIT_MS = 1500;

export class Link {
  /** take: {hello, vehicles, answer, bye, scene, changed}: functions. changed("open" | "lost" | "over", why) is called on each change; why: the
   * reason that the server gave for closing the connection, "" for none. */
  constructor(take) {
    this.take = take;
    this.state = "connecting";
    this.why = "";
    this.wait_ms = FIRST_WAIT_MS;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/scenes`, offered());
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => this.message(data);
    socket.onclose = ({ reason }) => {
      if (this.state !== "over") this.change("lost", reason);
      setTimeout(() => this.open(), this.wait_ms);
      this.wait_ms = Math.min(2 * this.wait_ms, LONGEST_WAIT_MS);
    };
    this.socket = socket;
  }

  /** Connect anew, with the word that people have entered. Without a connection the next one has it. */
  again() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    this.socket.onclose = this.socket.onmessage = null;
    this.socket.close();
    this.open();
  }

  message(data) {
    if (data instanceof ArrayBuffer) return this.take.scene(data);
    const said = JSON.parse(data);
    if (said.hello) {
      this.wait_ms = FIRST_WAIT_MS;
      this.take.hello(said.hello);
      this.change("open");
    } else if (said.vehicles) this.take.vehicles(said.vehicles, said.notice ?? "");
    else if (said.answer) this.take.answer(said.answer);
    else if (said.bye !== undefined) {
      this.take.bye(said.bye);
      this.change("over");
    }
  }

  change(state, why = "") {
    if (state === this.state && why === this.why) return;
    Object.assign(this, { state, why });
    this.take.changed(state, why);
  }

  /** Send a message; false if there is no connection. */
  say(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}
