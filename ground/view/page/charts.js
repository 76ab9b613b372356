// The charts: spread of the belief, and gas, against step. Drawn by uPlot.

import { colours, faded } from "./colours.js";
import { columns } from "./model.js";

const { uPlot } = window;
const FONT = "12px system-ui, sans-serif";

const axis = (more) => ({
  stroke: () => colours.muted.css,
  grid: { stroke: () => colours.grid.css, width: 1 },
  ticks: { stroke: () => colours.grid.css, width: 1, size: 4 },
  font: FONT, ...more,
});

function options(place, series, y, scales) {
  return {
    width: Math.max(100, place.clientWidth), height: place.clientHeight || 150,
    legend: { show: false }, padding: [10, 12, 0, 0],
    cursor: { drag: { x: false, y: false }, points: { size: 7 }, y: false },
    scales: { x: { time: false }, ...scales },
    axes: [axis({ size: 26, space: 42, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] }), axis({ size: 46, ...y })],
    series: [{}, ...series],
  };
}

/** A number of a logarithmic axis: 1, 2 or 5 times a power of ten; the others are not written. */
function decade(value) {
  if (!value) return "";
  const digits = Number(value.toPrecision(2));
  return /^[125]e/.test(digits.toExponential()) ? String(digits) : "";
}

/** A reading per step, another vehicle's beside it, and a level to compare with. */
export class Charts {
  constructor(spread, gas, spreadTitle, gasTitle) {
    this.titles = [spreadTitle, gasTitle];
    const other = { stroke: () => colours.muted.css, width: 1.5, dash: [2, 4], points: { show: false }, spanGaps: true };
    this.spread = new uPlot(
      options(spread, [
        { stroke: () => colours.belief.css, width: 2, points: { show: false } },
        { stroke: () => colours.estimate.css, width: 1.5, dash: [7, 4], points: { show: false }, spanGaps: true },
        other,
      ], { values: (_, splits) => splits.map(decade) },
      { y: { distr: 3, range: (_, low, high) => (low ? [Math.max(1e-3, low * 0.8), high * 1.25] : [0.1, 20]) } }),
      [[], [], [], []], spread);
    this.gas = new uPlot(
      options(gas, [
        { stroke: () => colours.reading.css, width: 1.5, fill: () => faded("reading", 0.15), points: { show: true, size: 5, fill: () => colours.reading.css, stroke: () => colours.ink.css, width: 0.5 } },
        other,
      ], { space: 24 }, { y: { range: (_, low, high) => (low === null ? [0, 1] : uPlot.rangeNum(low, high, 0.1, true)) } }),
      [[], [], []], gas);
    this.places = [[this.spread, spread], [this.gas, gas]];
    const fit = new ResizeObserver(() => {
      for (const [plot, place] of this.places) plot.setSize({ width: Math.max(100, place.clientWidth), height: place.clientHeight });
    });
    this.places.forEach(([, place]) => fit.observe(place));
    for (const plot of [this.spread, this.gas]) plot.hooks.setCursor = [() => this.tell()];
  }

  /** Draw a model; `other` is the one beside it or null; `last` is the last step that there will be, or null. */
  draw(model, other, last) {
    const tables = [model, ...(other ? [other] : [])].map(columns).map(({ steps, spread, gas }) => [steps, spread, gas]);
    const [steps, spread, gas, itsSpread, itsGas] = uPlot.join(tables);
    const none = steps.map(() => null);
    const threshold = model.scene.threshold_m;
    const x = [0, Math.max(last ?? 0, steps.at(-1) ?? 0, 10)];
    this.data = { steps, spread, gas };
    this.set(this.spread, [steps, spread, threshold ? steps.map(() => threshold) : none, itsSpread ?? none], x);
    this.set(this.gas, [steps, gas, itsGas ?? none], x);
    const more = [steps.length ? "" : "no reading yet", threshold ? `stops at ${threshold} (dashed)` : "", other ? `${other.name} dotted` : ""].filter(Boolean);
    this.titles[0].textContent = ["Spread by step, m", ...more].join(" · ");
    const now = steps.length - 1;
    for (const [place, what, values, unit] of [[this.places[0][1], "Spread", spread, " m"], [this.places[1][1], "Gas", gas, ""]]) {
      place.setAttribute("aria-label", now < 0 ? `${what} by step: no reading yet` : `${what} by step: ${values[now]?.toFixed(2)}${unit} at step ${steps[now]}`);
    }
    this.tell();
  }

  set(plot, data, [min, max]) {
    plot.batch(() => {
      plot.setData(data);
      plot.setScale("x", { min, max });
    });
  }

  /** Say the reading under the pointer. */
  tell() {
    const at = this.spread.cursor.idx ?? this.gas.cursor.idx;
    const gas = this.data?.gas[at ?? -1];
    this.titles[1].textContent = gas === undefined || gas === null ? "Gas by step" : `Step ${this.data.steps[at]}: gas ${gas.toFixed(2)}, spread ${this.data.spread[at].toFixed(2)} m`;
  }
}
