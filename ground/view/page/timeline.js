// The time line of records: scrub, play, step by reading, jump to events. It only says which moment is wanted.

import { marksOf } from "./charts.js";
import { seconds, setText } from "./words.js";

const SPEEDS = [1, 2, 5, 10, 20, 50];
const AT_THE_SAME_TIME_S = 1e-6;

export class TimeLine {
  /** seek(time_s) is called when another moment is wanted. */
  constructor(seek) {
    this.root = document.getElementById("timeline");
    this.find = (id) => document.getElementById(id);
    this.seek = seek;
    this.at_s = 0;
    this.speed = 10;
    this.playing = false;
    this.span = [0, 1];
    this.readings_s = this.events_s = [];
    for (const n of SPEEDS) this.find("speed").append(new Option(`${n}×`, n, n === this.speed, n === this.speed));
    this.find("speed").addEventListener("change", ({ target }) => this.setSpeed(Number(target.value)));
    this.find("at").addEventListener("input", ({ target }) => { this.pause(); this.go(Number(target.value)); });
    this.find("play").addEventListener("click", () => this.toggle());
    for (const [id, list, way] of [["event-back", "events_s", -1], ["event-on", "events_s", 1], ["step-back", "readings_s", -1], ["step-on", "readings_s", 1]]) {
      this.find(id).addEventListener("click", () => this.jump(list, way));
    }
  }

  /** Show the time line of these records, from the list of vehicles; hide it if there is none. */
  show(vehicles) {
    const records = vehicles.filter((vehicle) => vehicle.end_s !== null && vehicle.end_s !== undefined);
    const before = this.records;
    this.records = records.map((vehicle) => vehicle.name).join();
    this.root.hidden = !records.length;
    document.body.classList.toggle("replay", records.length > 0);
    if (!records.length) return;
    this.span = [Math.min(...records.map((r) => r.begin_s)), Math.max(...records.map((r) => r.end_s))];
    const inOrder = (lists) => [...new Set(lists.flat())].sort((a, b) => a - b);
    this.readings_s = inOrder(records.map((r) => r.readings_s ?? []));
    this.events_s = inOrder(records.map((r) => (r.moments ?? []).map(([time_s]) => time_s)));
    Object.assign(this.find("at"), { min: this.span[0], max: this.span[1] });
    this.drawMarks(records);
    // A record is opened at its end, with the outcome; playing begins anew from there.
    this.go(before ? this.at_s : this.span[1]);
  }

  drawMarks(records) {
    const rows = records.flatMap((record, row) => (record.moments ?? []).map((moment) => [moment, row]));
    const tell = (words) => setText(this.find("mark-words"), words);
    marksOf(this.find("marks"), rows.map(([moment]) => moment), this.span, tell, ([time_s]) => { this.pause(); this.go(time_s); });
    if (records.length > 1) [...this.find("marks").children].forEach((mark, i) => mark.classList.add(rows[i][1] ? "lower" : "upper"));
  }

  /** Go to a time, kept within the span. */
  go(time_s) {
    this.at_s = Math.min(this.span[1], Math.max(this.span[0], time_s));
    this.find("at").value = this.at_s;
    this.find("at").setAttribute("aria-valuetext", `${seconds(this.at_s)} of ${seconds(this.span[1])}`);
    setText(this.find("clock"), `${this.at_s.toFixed(1)} / ${seconds(this.span[1])}`);
    this.seek(this.at_s);
  }

  /** Go to the next time of a list of times, or to the one before. */
  jump(list, way) {
    this.pause();
    const times = this[list];
    const next = way > 0 ? times.find((t) => t > this.at_s + AT_THE_SAME_TIME_S) : times.findLast((t) => t < this.at_s - AT_THE_SAME_TIME_S);
    if (next !== undefined) this.go(next);
  }

  toggle() {
    if (this.playing) return this.pause();
    if (this.at_s >= this.span[1]) this.go(this.span[0]);
    this.playing = true;
    this.label();
    let last_ms = null;
    const frame = (now_ms) => {
      if (!this.playing) return;
      if (last_ms !== null) this.go(this.at_s + ((now_ms - last_ms) / 1000) * this.speed);
      last_ms = now_ms;
      if (this.at_s >= this.span[1]) return this.pause();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  pause() {
    this.playing = false;
    this.label();
  }

  label() {
    const button = this.find("play");
    button.classList.toggle("playing", this.playing);
    button.setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  setSpeed(speed) {
    this.speed = speed;
    this.find("speed").value = String(speed);
  }

  /** Play faster or slower by one notch. */
  notch(way) {
    this.setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, SPEEDS.indexOf(this.speed) + way))]);
  }
}
