// The map: area, true plume, belief, trail, readings, vehicle, waypoint and estimate on one canvas. Metres, north up.

import { colours, faded } from "./colours.js";
import { readings } from "./model.js";

const LEFT = 30, RIGHT = 10, TOP = 40, BOTTOM = 24; // px around the area
const MARGIN = 0.02; // of the area, seen around it
const FONT = "12px system-ui, sans-serif";
const SHADES = 10; // of particles
const DECADES = 3; // of gas, in the true plume

/** One map. */
export class WorldMap {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.plume = document.createElement("canvas"); // one pixel a cell
    this.plumeOf = null;
    new ResizeObserver(() => { this.resize(); changed(); }).observe(canvas);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    Object.assign(this, { width, height, ratio });
  }

  /** Draw a model. The view: {x(m) and y(m) to px, side px, left and top px of the area}. */
  draw(model) {
    const scene = model.scene;
    if (this.ratio !== (devicePixelRatio || 1)) this.resize();
    if (!this.width || !scene) return;
    const side = Math.max(40, Math.min(this.width - LEFT - RIGHT, this.height - TOP - BOTTOM));
    const left = LEFT + Math.floor((this.width - LEFT - RIGHT - side) / 2), top = TOP;
    const { west, south, width, height, longer } = extent(scene);
    const edge = Math.max(longer * MARGIN, 1.5 * beyond(scene)), scale = side / (longer + 2 * edge);
    const x0 = west - (longer - width) / 2 - edge, y0 = south - (longer - height) / 2 - edge; // the map is square
    const view = {
      side, left, top, scale,
      x: (m) => left + (m - x0) * scale,
      y: (m) => top + side - (m - y0) * scale,
    };
    this.view = view;
    const g = this.canvas.getContext("2d");
    g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    g.clearRect(0, 0, this.width, this.height);
    g.font = FONT;
    g.lineJoin = g.lineCap = "round";
    drawGrid(g, view, extent(scene));
    drawScale(g, view, longer);
    drawWind(g, view, scene.wind);
    g.save();
    g.beginPath();
    g.rect(left, top, side, side);
    g.clip();
    if (scene.truth && model.plume) this.drawPlume(g, view, scene, model);
    drawParticles(g, view, model.particles);
    drawTrack(g, view, model.track);
    drawReadings(g, view, readings(model));
    drawWaypoint(g, view, scene);
    if (scene.estimate) drawEstimate(g, view, scene.estimate);
    for (const source of scene.truth?.sources ?? []) drawSource(g, view, source);
    if (isPlaced(scene.craft)) drawCraft(g, view, scene.craft);
    g.restore();
    this.canvas.setAttribute("aria-label", inWords(scene));
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
}

/** A round number of metres, at least `least`: 1, 2 or 5 times a power of ten. */
export function round(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((n) => n * power >= least * 0.999);
}

/** Where a scene's area lies and how long it is, m. */
function extent({ area: [west, south, east, north] }) {
  const width = east - west, height = north - south;
  return { west, south, east, north, width, height, longer: Math.max(width, height) };
}

/** How far the estimate or a true source is beyond the area's edges, m. */
function beyond(scene) {
  const { west, south, east, north, longer } = extent(scene), { estimate, truth } = scene;
  const places = [...(estimate ? [[estimate.x, estimate.y]] : []), ...(truth?.sources ?? [])];
  return Math.min(longer, Math.max(0, ...places.flatMap(([x, y]) => [west - x, x - east, south - y, y - north]))); // a record may say absurd things
}

function drawGrid(g, view, { west, south, east, north, width, height, longer }) {
  const step = round(longer / (view.side < 340 ? 4 : 7));
  g.fillStyle = colours.card.css;
  g.fillRect(view.left, view.top, view.side, view.side);
  g.strokeStyle = colours.grid.css;
  g.fillStyle = colours.muted.css;
  g.lineWidth = 1;
  g.beginPath();
  g.textAlign = "center";
  g.textBaseline = "top";
  for (const m of rounds(west, east, step)) {
    const x = Math.round(view.x(m)) + 0.5;
    g.moveTo(x, view.y(south));
    g.lineTo(x, view.y(north));
    g.fillText(m, x, view.top + view.side + 5);
  }
  g.textAlign = "right";
  g.textBaseline = "middle";
  for (const m of rounds(south, north, step)) {
    const y = Math.round(view.y(m)) + 0.5;
    g.moveTo(view.x(west), y);
    g.lineTo(view.x(east), y);
    g.fillText(m, view.left - 6, y);
  }
  g.stroke();
  g.strokeStyle = colours.muted.css;
  g.strokeRect(Math.round(view.x(west)) + 0.5, Math.round(view.y(north)) + 0.5, Math.round(width * view.scale), Math.round(height * view.scale));
  g.textAlign = "right";
  g.textBaseline = "top";
  g.fillText("m", view.left - 6, view.top + view.side + 5);
}

/** The multiples of a step from one number to another. */
function rounds(from, to, step) {
  const first = Math.ceil(from / step - 1e-9), last = Math.floor(to / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step);
}

function drawScale(g, view, longer) {
  const m = round(longer / 7), right = view.left + view.side, y = 24;
  const left = right - m * view.scale;
  g.strokeStyle = colours.ink.css;
  g.fillStyle = colours.ink.css;
  g.lineWidth = 1.5;
  g.beginPath();
  g.moveTo(left, y - 4);
  g.lineTo(left, y);
  g.lineTo(right, y);
  g.lineTo(right, y - 4);
  g.stroke();
  g.textAlign = "center";
  g.textBaseline = "bottom";
  g.fillText(`${m} m`, (left + right) / 2, y - 3);
  g.textAlign = "right";
  g.fillText("N ↑", left - 14, y + 3);
}

const POINTS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

/** Where a wind comes from, as a bearing in degrees from north. */
export function bearing([x, y]) {
  return Math.round((Math.atan2(x, y) * 180) / Math.PI + 360) % 360;
}

function drawWind(g, view, wind) {
  const middle = [view.left + 16, 19];
  const speed = wind ? Math.hypot(...wind) : 0;
  g.fillStyle = g.strokeStyle = colours.ink.css;
  g.textAlign = "left";
  g.textBaseline = "middle";
  if (!wind) return;
  const from = bearing(wind);
  g.save();
  g.translate(...middle);
  g.rotate(Math.atan2(wind[1], -wind[0])); // air moves to −wind; the canvas has y down
  g.lineWidth = 2;
  g.beginPath();
  if (speed > 0) {
    g.moveTo(-13, 0);
    g.lineTo(9, 0);
    g.stroke();
    g.beginPath();
    g.moveTo(14, 0);
    g.lineTo(5, -5);
    g.lineTo(5, 5);
    g.fill();
  }
  g.restore();
  const words = view.side < 300 ? "" : "wind ";
  g.fillText(`${words}${speed.toFixed(1)} m/s from ${POINTS[Math.round(from / 45) % 8]} (${from}°)`, middle[0] + 22, middle[1]);
}

function drawParticles(g, view, values) {
  const count = values.length / 3;
  if (!count) return;
  const size = Math.min(3.5, Math.max(1.6, view.side / 200)), half = size / 2;
  const even = 0.5 * Math.min(1.1, (1000 / count) ** 0.25); // how opaque an even weight, 1 / count, is drawn
  const shades = Array.from({ length: SHADES }, () => []);
  for (let i = 0; i < count; i++) {
    const alpha = Math.min(0.95, Math.max(0.08, even * Math.sqrt(values[3 * i + 2] * count)));
    shades[Math.min(SHADES - 1, Math.floor(alpha * SHADES))].push(i);
  }
  shades.forEach((members, shade) => {
    g.fillStyle = faded("belief", (shade + 0.5) / SHADES);
    for (const i of members) g.fillRect(view.x(values[3 * i]) - half, view.y(values[3 * i + 1]) - half, size, size);
  });
}

function drawTrack(g, view, track) {
  if (track.length < 4) return;
  g.beginPath();
  for (let i = 0; i < track.length; i += 2) g.lineTo(view.x(track[i]), view.y(track[i + 1]));
  haloed(g, colours.ink.css, 1.6);
}

/** Stroke the path with an edge of the paper's colour, so that it is seen on anything. */
function haloed(g, css, width) {
  g.strokeStyle = faded("card", 0.8);
  g.lineWidth = width + 2.5;
  g.stroke();
  g.strokeStyle = css;
  g.lineWidth = width;
  g.stroke();
}

/** Whether a vehicle has said where it is. */
const isPlaced = (craft) => Number.isFinite(craft?.x) && Number.isFinite(craft?.y);

function drawReadings(g, view, rows) {
  const most = rows.reduce((a, [, , gas]) => Math.max(a, gas), 0) || 1;
  g.lineWidth = 1;
  for (const [x, y, gas] of rows) {
    g.beginPath();
    g.arc(view.x(x), view.y(y), 2 + 6 * Math.sqrt(Math.max(gas, 0) / most), 0, 2 * Math.PI);
    g.fillStyle = faded("reading", 0.85);
    g.fill();
    g.strokeStyle = colours.ink.css;
    g.stroke();
  }
}

function drawWaypoint(g, view, { waypoint, craft }) {
  if (!waypoint) return;
  const [x, y] = [view.x(waypoint[0]), view.y(waypoint[1])];
  if (isPlaced(craft)) {
    g.beginPath();
    g.moveTo(view.x(craft.x), view.y(craft.y));
    g.lineTo(x, y);
    g.setLineDash([4, 4]);
    haloed(g, colours.waypoint.css, 1.5);
    g.setLineDash([]);
  }
  g.beginPath();
  for (const [dx, dy] of [[0, -7], [7, 0], [0, 7], [-7, 0]]) g.lineTo(x + dx, y + dy);
  g.closePath();
  haloed(g, colours.waypoint.css, 2.2);
}

function drawEstimate(g, view, { x, y, ellipse: [longer, shorter, angle] }) {
  const [px, py] = [view.x(x), view.y(y)];
  g.beginPath();
  g.ellipse(px, py, longer * view.scale, shorter * view.scale, -angle, 0, 2 * Math.PI);
  haloed(g, colours.estimate.css, 1.8);
  g.beginPath();
  for (const [dx, dy] of [[8, 0], [0, 8]]) {
    g.moveTo(px - dx, py - dy);
    g.lineTo(px + dx, py + dy);
  }
  haloed(g, colours.estimate.css, 2.6);
}

function drawSource(g, view, [x, y]) {
  const [px, py] = [view.x(x), view.y(y)];
  g.beginPath();
  g.arc(px, py, 9, 0, 2 * Math.PI);
  haloed(g, colours.truth.css, 2.4);
  g.beginPath();
  g.arc(px, py, 2.8, 0, 2 * Math.PI);
  g.fillStyle = colours.truth.css;
  g.fill();
}

function drawCraft(g, view, { x, y, heading }) {
  g.save();
  g.translate(view.x(x), view.y(y));
  g.beginPath();
  if (heading === null) g.arc(0, 0, 6, 0, 2 * Math.PI);
  else {
    g.rotate(-heading);
    for (const [dx, dy] of [[12, 0], [-8, -7.5], [-4, 0], [-8, 7.5]]) g.lineTo(dx, dy);
    g.closePath();
  }
  haloed(g, colours.ink.css, 2);
  g.fillStyle = colours.ink.css;
  g.fill();
  g.restore();
}

/** What the map shows, for who cannot see it. */
function inWords(scene) {
  const { craft, estimate, wind, truth } = scene, { width, height } = extent(scene);
  const at = (x, y) => `(${x.toFixed(1)}, ${y.toFixed(1)})`;
  const said = [width === height ? `Map, ${width} m square` : `Map, ${width} m by ${height} m`];
  if (isPlaced(craft)) said.push(`vehicle at ${at(craft.x, craft.y)}`);
  if (estimate) said.push(`estimate at ${at(estimate.x, estimate.y)} ± ${estimate.spread_m.toFixed(2)} m`);
  if (wind) said.push(`wind ${Math.hypot(...wind).toFixed(1)} m/s from ${bearing(wind)}°`);
  for (const source of truth?.sources ?? []) said.push(`true source at ${at(...source)}`);
  return said.join("; ");
}
