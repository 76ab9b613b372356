// The charts: one time axis, on which events are marked. Drawn by uPlot. Spread and gas at first, the others when they are asked for.

import { colours, faded } from "./colours.js";
import { columns } from "./model.js";
import { make, seconds, setText } from "./words.js";

const { uPlot } = window;
const FONT = "12px system-ui, sans-serif";
const LEFT = 46, RIGHT = 12; // px beside the plots
const MOST_MARKS = 60;

const axis = (more) => ({
  stroke: () => colours.muted.css,
  grid: { stroke: () => colours.grid.css, width: 1 },
  ticks: { stroke: () => colours.grid.css, width: 1, size: 4 },
  font: FONT, ...more,
});

const line = (name, more) => ({ stroke: () => colours[name].css, width: 2, points: { show: false }, spanGaps: true, ...more });
const OTHER = line("muted", { width: 1.5, dash: [2, 4] });
const LEVEL = line("estimate", { width: 1.5, dash: [7, 4] });

/** A number of a logarithmic axis: 1, 2 or 5 times a power of ten; the others are not written. */
function decade(value) {
  if (!value) return "";
  const digits = Number(value.toPrecision(2));
  return /^[125]e/.test(digits.toExponential()) ? String(digits) : "";
}

const linear = { range: (_, low, high) => (low === null ? [0, 1] : uPlot.rangeNum(low, high, 0.1, true)) };
const logarithmic = (least) => ({ distr: 3, range: (_, low, high) => (low ? [Math.max(least, low * 0.8), high * 1.25] : [0.1, 20]) });
const decades = { values: (_, splits) => splits.map(decade) };

// Of each chart: its title, unit, lines, axis and scale, and its columns of a table of measurements. The first line is the one that is told.
const CHARTS = {
  spread: ["Spread", "m", [line("belief"), LEVEL, OTHER], decades, logarithmic(1e-3)],
  gas: ["Gas", "", [line("reading", { width: 1.5, fill: () => faded("reading", 0.15), points: { show: true, size: 5, fill: () => colours.reading.css, stroke: () => colours.ink.css, width: 0.5 } }), OTHER], { space: 24 }, linear],
  rate: ["Release rate, with 90% of the belief", "kg/h", [line("belief"), line("belief", { width: 1, dash: [4, 3] }), line("belief", { width: 1, dash: [4, 3] })], decades, logarithmic(1e-6)],
  from: ["Wind comes from", "°", [line("waypoint")], { space: 24 }, { range: (_, low, high) => (low === null ? [0, 360] : [Math.max(0, low - 10), Math.min(360, high + 10)]) }],
  p: ["Fit of the readings (p-value)", "", [line("ink"), LEVEL], decades, logarithmic(1e-12)],
  evidence: ["Evidence for gas", "nats", [line("waypoint"), LEVEL], { space: 24 }, linear],
  size: ["Effective sample size", "particles", [line("ink")], { space: 24 }, linear],
};
const BASIC = ["spread", "gas"];
const FITS = 1e-4, CLEAR = 5; // below this p-value, or this evidence, there is no stop

/** The charts of one vehicle. */
export class Charts {
  /** basic, more: places; marks: the strip of events above them; tell(words): what is at the mark that is pointed at. */
  constructor(basic, more, marks, tell) {
    this.marks = marks;
    this.tellMark = tell;
    this.events = [];
    this.plots = {};
    this.places = { basic, more };
    this.sync = uPlot.sync(`charts ${Math.random()}`);
    for (const name of BASIC) this.add(name, basic);
  }

  get spread() { return this.plots.spread.plot; }
  get gas() { return this.plots.gas.plot; }

  /** Show the others as well. */
  open() {
    for (const name of Object.keys(CHARTS)) if (!this.plots[name]) this.add(name, this.places.more);
    this.redraw?.();
  }

  add(name, parent) {
    const [title, unit, series, y, scale] = CHARTS[name];
    const section = make("section"), head = make("h3", `${name}-title`, title), place = make("div", `chart ${name}`);
    place.setAttribute("role", "img");
    section.append(head, place);
    parent.append(section);
    const plot = new uPlot({
      width: Math.max(100, place.clientWidth), height: place.clientHeight || 120,
      legend: { show: false }, padding: [8, RIGHT, 0, 0],
      cursor: { drag: { x: false, y: false }, points: { size: 7 }, y: false, sync: { key: this.sync.key } },
      scales: { x: { time: false }, y: scale },
      axes: [axis({ size: 24, space: 42, values: (_, splits) => splits.map((s, i) => (i === splits.length - 1 ? `${s} s` : s)) }), axis({ size: LEFT, ...y })],
      series: [{}, ...series],
      hooks: { draw: [(u) => this.drawEvents(u)], setCursor: [() => this.tell()] },
    }, [[], ...series.map(() => [])], place);
    this.plots[name] = { plot, place, head, title, unit };
    new ResizeObserver(() => plot.setSize({ width: Math.max(100, place.clientWidth), height: place.clientHeight || 120 })).observe(place);
  }

  /** Draw a model; `other` is the one beside it or null; `last_s` is the last time that there will be, or null; `events` are rows of happenings. */
  draw(model, other, last_s, events) {
    this.redraw = () => this.draw(model, other, last_s, this.events);
    const ours = columns(model), { threshold_m, gauge } = model.scene;
    this.table = ours;
    this.events = events.filter(([, level, who, text]) => level !== "info" || (who === "uav" && !text.startsWith("mode "))).slice(-MOST_MARKS);
    const none = ours.times.map(() => null), level = (value) => (value ? ours.times.map(() => value) : none);
    const x = [0, Math.max(last_s ?? 0, ours.times.at(-1) ?? 0, 10)];
    const its = other ? columns(other) : null;
    const beside = (mine, theirs) => (its ? uPlot.join([[ours.times, ...mine], [its.times, theirs]]) : [ours.times, ...mine, none]);
    const tables = {
      spread: beside([ours.spread, level(threshold_m)], its?.spread), gas: beside([ours.gas], its?.gas), rate: [ours.times, ours.rate[1], ours.rate[0], ours.rate[2]],
      from: [ours.times, ours.from], p: [ours.times, ours.p.map((p) => (p === null ? null : Math.max(p, 1e-12))), level(FITS)], evidence: [ours.times, ours.evidence, level(CLEAR)], size: [ours.times, ours.size],
    };
    const now = ours.times.length - 1;
    for (const [name, { plot, place, title }] of Object.entries(this.plots)) {
      const unit = name === "gas" ? (gauge?.unit ?? "") : CHARTS[name][1], value = tables[name][1].findLast((each) => each !== null && each !== undefined);
      Object.assign(this.plots[name], { unit, note: name === "spread" && threshold_m ? `limit ${threshold_m} m (dashed)` : "" });
      if (other && (name === "spread" || name === "gas")) this.plots[name].note = [this.plots[name].note, `${other.name} dotted`].filter(Boolean).join(" · ");
      place.setAttribute("aria-label", now < 0 || value === undefined ? `${title}: no reading yet` : `${title}: ${short(value)} ${unit}`.trim());
      plot.batch(() => { plot.setData(tables[name]); plot.setScale("x", { min: x[0], max: x[1] }); });
    }
    this.drawMarks(x);
    this.tell();
  }

  /** A thin line at each event. */
  drawEvents(u) {
    const g = u.ctx, { left, top, width, height } = u.bbox;
    g.save();
    g.strokeStyle = faded("muted", 0.7);
    g.lineWidth = devicePixelRatio || 1;
    g.setLineDash([2, 3]);
    for (const [time_s] of this.events) {
      const at = Math.round(u.valToPos(time_s, "x", true));
      if (at < left || at > left + width) continue;
      g.beginPath();
      g.moveTo(at, top);
      g.lineTo(at, top + height);
      g.stroke();
    }
    g.restore();
  }

  drawMarks([begin, end]) {
    const key = JSON.stringify([this.events, begin, end]);
    if (key === this.markKey) return;
    this.markKey = key;
    marksOf(this.marks, this.events, [begin, end], this.tellMark);
  }

  /** Say the values under the pointer, or the newest. */
  tell() {
    if (!this.table) return;
    const { plot: first } = this.plots.spread, at_s = first.cursor.idx === null || first.cursor.idx === undefined ? null : first.data[0][first.cursor.idx];
    const row = at_s === null ? this.table.times.length - 1 : this.table.times.indexOf(at_s);
    const when = at_s !== null && row >= 0 ? ` at ${seconds(at_s)}, reading ${this.table.steps[row]}` : "";
    for (const { head, title, unit, plot, note } of Object.values(this.plots)) {
      const values = plot.data[1] ?? [], value = when ? values[plot.data[0].indexOf(at_s)] : values.findLast(Number.isFinite);
      const said = Number.isFinite(value) ? `: ${short(value)}${unit ? (unit === "°" ? "°" : ` ${unit}`) : ""}${when}` : ` · no reading${when || " yet"}`;
      setText(head, [title + said, when ? "" : note].filter(Boolean).join(" · "));
    }
  }
}

const short = (value) => String(Number(value.toPrecision(3)));

/** Fill a strip with marks of events, rows of [time_s, level, who, text], that say what they are; chosen(row) is called where one is pressed. */
export function marksOf(strip, events, [begin, end], tell, chosen = () => {}) {
  strip.replaceChildren(...events.map((row) => {
    const [time_s, level, who, text] = row, mark = make("button", "mark"), words = `${seconds(time_s)} · ${who}: ${text}`;
    mark.type = "button";
    mark.dataset.level = level;
    mark.title = words;
    mark.setAttribute("aria-label", words);
    mark.style.left = `${(100 * (time_s - begin)) / (end - begin || 1)}%`;
    mark.addEventListener("focus", () => tell(words));
    mark.addEventListener("pointerenter", () => tell(words));
    mark.addEventListener("click", () => { tell(words); chosen(row); });
    return mark;
  }));
}
