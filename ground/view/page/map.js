// The map on one canvas: it fills its window, and shows the belief large in a corner when it is small.

import * as draw from "./draw.js";
import { colours } from "./colours.js";
import { readings } from "./model.js";
import { away, coordinates } from "./words.js";
import { Camera, extent, followHands, isPlaced, moved, reach, viewOf } from "./view.js";

const FONT = "12px system-ui, sans-serif";
const SMALL = 16; // px: a belief that reaches less far from the estimate gets an inset
const BESIDE = 14; // px that an inset stays from vehicles and from the belief
const NEAR = 11; // px from a reading that the pointer is at
const DECADES = 3; // of gas, in the true plume

/** One map. */
export class WorldMap {
  /** told(text): what is under the pointer; changed(): draw again. */
  constructor(canvas, changed, told = () => {}) {
    this.canvas = canvas;
    this.told = told;
    this.camera = new Camera();
    this.plume = document.createElement("canvas"); // one pixel a cell
    this.plumeOf = null;
    this.picture = null; // {image, west, south, width, height}: m
    this.pointer = null;
    new ResizeObserver(() => { this.resize(); if (this.model) this.draw(this.model, this.others); }).observe(canvas); // at once: a resized canvas is empty
    followHands(canvas, this.camera, { view: () => this.view, changed, tell: (...at) => { this.pointer = at[0] === null ? null : at; this.tell(); } });
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    Object.assign(this, { width, height, ratio });
  }

  /** Draw a model, and the models of other vehicles on the same map. */
  draw(model, others = []) {
    const scene = model.scene;
    if (this.ratio !== (devicePixelRatio || 1)) this.resize();
    if (!this.width || !scene) return;
    Object.assign(this, { model, others });
    const view = this.view = this.camera.view(scene, others.flatMap((other) => placesOf(model, other)), this.width, this.height);
    const g = this.canvas.getContext("2d");
    g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    g.font = FONT;
    g.lineJoin = g.lineCap = "round";
    g.fillStyle = colours.card.css;
    g.fillRect(0, 0, this.width, this.height);
    if (this.picture) draw.picture(g, view, this.picture);
    draw.grid(g, view, this.width, this.height, scene);
    this.drawWorld(g, view, model, others, false);
    draw.numbers(g, view, this.width, this.height);
    draw.scaleBar(g, view, this.width, this.height);
    draw.wind(g, scene.wind, model.measurements, this.width);
    this.inset = this.insetOf(scene, view, others);
    if (this.inset) this.drawInset(g, model, others);
    this.canvas.setAttribute("aria-label", inWords(scene, others));
    this.tell();
  }

  /** All that lies in the world. */
  drawWorld(g, view, model, others, large) {
    const { scene } = model;
    if (scene.truth && model.plume) this.drawPlume(g, view, scene, model);
    const beside = others.map((one) => [one, moved(view, away(scene.home, one.scene.home))]); // each from its own home
    for (const [one, its] of beside.filter(([other]) => isElsewhere(model, other))) {
      draw.edge(g, its, one.scene);
      draw.walls(g, its, one.walls);
      draw.fence(g, its, one.fence);
      draw.home(g, its, one.scene);
    }
    draw.walls(g, view, model.walls);
    draw.fence(g, view, model.fence);
    draw.particles(g, view, model.particles, large);
    for (const [one, its] of beside) draw.track(g, its, one.track, true);
    draw.track(g, view, model.track, false);
    for (const [one, its] of [...beside, [model, view]]) draw.readings(g, its, readings(one), one.scene.gauge);
    for (const [one, its] of [...beside, [model, view]]) draw.waypoint(g, its, one.scene);
    draw.home(g, view, scene);
    if (scene.estimate) draw.estimate(g, view, scene.estimate);
    for (const source of scene.truth?.sources ?? []) draw.source(g, view, source);
    const named = [];
    for (const [one, its] of [...beside, [model, view]]) {
      if (!isPlaced(one.scene.craft)) continue;
      draw.craft(g, its, one.scene.craft, one !== model);
      if (others.length && !large) draw.name(g, its, one.scene.craft, one.label, named);
    }
  }

  /**
   * The window of the inset in px, null where none is wanted. It lies in the lower corner that is farther from the belief, in the other one,
   * or in the upper left one: the first where it hides no vehicle, else the first where it hides only others.
   */
  insetOf(scene, view, others) {
    if (!scene.estimate || this.camera.mode === "belief") return null;
    const radius = reach(scene.estimate);
    if (radius * view.scale >= SMALL) return null;
    const side = Math.round(Math.max(96, Math.min(190, 0.3 * Math.min(this.width, this.height))));
    const low = this.height - side - 58, corners = [[46, low], [this.width - side - 12, low]];
    if (view.x(scene.estimate.x) < this.width / 2) corners.reverse();
    corners.push([28, 44]); // below the wind, beside the buttons of a phone
    const own = [scene.estimate, placeOf(scene, scene)], all = [...own, ...others.map((one) => placeOf(scene, one.scene))];
    const hides = ([left, top], places) => places.some((at) => at && Math.abs(view.x(at.x) - left - side / 2) < side / 2 + BESIDE && Math.abs(view.y(at.y) - top - side / 2) < side / 2 + BESIDE);
    const [left, top] = corners.find((corner) => !hides(corner, all)) ?? corners.find((corner) => !hides(corner, own)) ?? corners[0];
    return { left, top, width: side, height: side, scale: side / Math.max(1, 5 * radius) };
  }

  drawInset(g, model, others) {
    const { left, top, width, height, scale } = this.inset, { estimate } = model.scene;
    const view = viewOf([estimate.x, estimate.y], scale, this.inset);
    g.save();
    g.beginPath();
    g.rect(left, top, width, height);
    g.fillStyle = colours.card.css;
    g.fill();
    g.clip();
    this.drawWorld(g, view, model, others, true);
    g.restore();
    g.strokeStyle = colours.estimate.css;
    g.lineWidth = 2;
    g.strokeRect(left, top, width, height);
    draw.label(g, `${Number((width / scale).toPrecision(2))} m wide`, left + width / 2, top + height - 4, "center", "bottom");
  }

  drawPlume(g, view, scene, model) {
    const { cells, values, most } = model.plume;
    const key = `${colours.truth.css} ${cells} ${most}`;
    if (model.fresh.plume || this.plumeOf !== key) {
      this.plumeOf = key;
      this.plume.width = this.plume.height = cells;
      const image = new ImageData(cells, cells);
      const [r, green, b] = colours.truth.rgb;
      for (let row = 0; row < cells; row++) {
        for (let column = 0; column < cells; column++) {
          const share = 1 + Math.log10(values[row * cells + column] / most) / DECADES; // 0 at a thousandth of the most, 1 at the most
          image.data.set([r, green, b, share > 0 ? 190 * share : 0], 4 * ((cells - 1 - row) * cells + column));
        }
      }
      this.plume.getContext("2d").putImageData(image, 0, 0);
      model.fresh.plume = false;
    }
    const { west, north, width, height } = extent(scene);
    g.drawImage(this.plume, view.x(west), view.y(north), width * view.scale, height * view.scale);
  }

  /** Say what is under the pointer. */
  tell() {
    if (!this.pointer || !this.view || !this.model) return this.told("");
    const [px, py] = this.pointer, { view, model, model: { scene }, others } = this;
    const east = view.east(px), north = view.north(py);
    const said = [`${east.toFixed(1)} m east, ${north.toFixed(1)} m north`];
    if (scene.home) said.push(coordinates(scene.home, east, north));
    let best = { far: NEAR };
    for (const one of [...others, model]) {
      const its = moved(view, away(scene.home, one.scene.home));
      for (const row of readings(one)) {
        const far = Math.hypot(its.x(row[2]) - px, its.y(row[3]) - py);
        if (far <= best.far) best = { far, row, one };
      }
    }
    if (best.row) {
      const [step, time_s, , , gas] = best.row, { gauge } = best.one.scene;
      said.unshift(`${others.length ? `${best.one.label}, ` : ""}reading ${step}: ${gas.toPrecision(3)}${gauge?.unit ? ` ${gauge.unit}` : ""}${gauge && !draw.level(gauge, gas) ? ", noise" : ""}, at ${time_s.toFixed(1)} s`);
    }
    this.told(said.join(" · "));
  }
}

/** Where the vehicle of another scene is on the map of this one, {x, y} m; null where it is not known. */
function placeOf({ home }, { craft, home: its }) {
  if (!isPlaced(craft)) return null;
  const [east, north] = away(home, its);
  return { x: craft.x + east, y: craft.y + north };
}

/** Whether another model searches an area that is not this one's. */
function isElsewhere({ scene, search }, other) {
  return other.search !== search && (away(scene.home, other.scene.home).some(Boolean) || String(other.scene.area) !== String(scene.area));
}

/** What should be seen of another model on the map of this one: the vehicle, and the area where that is another. */
function placesOf({ scene, search }, other) {
  const [east, north] = away(scene.home, other.scene.home), area = extent(other.scene);
  const corners = !isElsewhere({ scene, search }, other) ? [] : [{ x: area.west + east, y: area.south + north }, { x: area.east + east, y: area.north + north }];
  return [placeOf(scene, other.scene), ...corners];
}

/** What the map shows, for who cannot see it. */
function inWords(scene, others) {
  const { craft, estimate, wind, truth, waypoint } = scene, { width, height } = extent(scene);
  const at = (x, y) => `(${x.toFixed(1)}, ${y.toFixed(1)})`;
  const said = [width === height ? `Map, ${width} m square` : `Map, ${width} m by ${height} m`];
  if (isPlaced(craft)) said.push(`vehicle at ${at(craft.x, craft.y)}`);
  for (const other of others) {
    const place = placeOf(scene, other.scene);
    if (place) said.push(`${other.label} at ${at(place.x, place.y)}`);
  }
  if (waypoint) said.push(`next waypoint ${at(...waypoint)}`);
  if (estimate) said.push(`estimate at ${at(estimate.x, estimate.y)}, 95% of the belief within ${reach(estimate).toFixed(1)} m`);
  if (wind) said.push(`wind ${Math.hypot(...wind).toFixed(1)} m/s from ${draw.bearing(wind)}°`);
  for (const source of truth?.sources ?? []) said.push(`true source at ${at(...source)}`);
  return said.join("; ");
}
