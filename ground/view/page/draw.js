// How each thing looks on the map. A view says where metres are in pixels.

import { colours, faded } from "./colours.js";
import { extent, isPlaced } from "./view.js";

const SHADES = 10; // of particles
const EARLIER = 12; // readings whose winds are shown, pale, behind the newest
const LINE = 14; // px between two lines of words
const APART = 6; // px between two names in a line
const POINTS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

/** A round number of metres, at least `least`: 1, 2 or 5 times a power of ten. */
export function round(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((n) => n * power >= least * 0.999);
}

/** The round numbers of metres along an axis, from and to px. */
function ticks(view, from, to) {
  const step = round(70 / view.scale), first = Math.ceil(Math.min(from, to) / step), last = Math.floor(Math.max(from, to) / step);
  return Array.from({ length: Math.min(200, Math.max(0, last - first + 1)) }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** The grid of the window, and the edge of a scene's area. */
export function grid(g, view, width, height, scene) {
  g.strokeStyle = colours.grid.css;
  g.lineWidth = 1;
  g.beginPath();
  for (const m of ticks(view, view.east(0), view.east(width))) {
    const x = Math.round(view.x(m)) + 0.5;
    g.moveTo(x, 0);
    g.lineTo(x, height);
  }
  for (const m of ticks(view, view.north(height), view.north(0))) {
    const y = Math.round(view.y(m)) + 0.5;
    g.moveTo(0, y);
    g.lineTo(width, y);
  }
  g.stroke();
  edge(g, view, scene);
}

/** The edge of a scene's area. */
export function edge(g, view, scene) {
  g.strokeStyle = colours.muted.css;
  g.lineWidth = 1.5;
  const area = extent(scene);
  g.strokeRect(view.x(area.west), view.y(area.north), area.width * view.scale, area.height * view.scale);
}

/** The numbers of the grid along the left and lower edges. */
export function numbers(g, view, width, height) {
  for (const m of ticks(view, view.east(40), view.east(width - 8))) label(g, m, view.x(m), height - 6, "center", "bottom", colours.muted.css);
  for (const m of ticks(view, view.north(height - 28), view.north(50))) label(g, m, 6, view.y(m), "left", "middle", colours.muted.css);
  label(g, "m", 6, height - 6, "left", "bottom", colours.muted.css);
}

/** Words that can be read on anything. */
export function label(g, text, x, y, align, baseline, css = colours.ink.css) {
  Object.assign(g, { textAlign: align, textBaseline: baseline, strokeStyle: faded("card", 0.9), lineWidth: 3, fillStyle: css });
  g.strokeText(text, x, y);
  g.fillText(text, x, y);
}

export function scaleBar(g, view, width, height) {
  const m = round(70 / view.scale), right = width - 14, left = right - m * view.scale, y = height - 30;
  g.beginPath();
  g.moveTo(left, y - 4);
  g.lineTo(left, y);
  g.lineTo(right, y);
  g.lineTo(right, y - 4);
  haloed(g, colours.ink.css, 1.5);
  label(g, `${m} m`, (left + right) / 2, y - 5, "center", "bottom");
  label(g, "N ↑", left - 8, y + 3, "right", "bottom");
}

/** Where a wind comes from, as a bearing in degrees from north. */
export function bearing([x, y]) {
  return Math.round((Math.atan2(x, y) * 180) / Math.PI + 360) % 360;
}

/** The wind: an arrow to where the air goes, pale ones of earlier readings, and words. */
export function wind(g, now, rows, width) {
  if (!now) return;
  const middle = [24, 24];
  const earlier = rows.slice(-EARLIER).map((row) => [row[9], row[10]]).filter(([x]) => x !== null && x !== undefined);
  earlier.forEach((each, i) => arrow(g, middle, each, faded("ink", 0.08 + (0.2 * i) / EARLIER), 1.5));
  if (Math.hypot(...now) > 0) arrow(g, middle, now, colours.ink.css, 2);
  const from = bearing(now);
  const turned = earlier.length ? Math.round((((from - bearing(earlier[0])) % 360) + 540) % 360 - 180) : 0;
  const words = width < 420 ? "" : "wind ";
  const turns = Math.abs(turned) >= 15 ? `, turned ${Math.abs(turned)}° ${turned > 0 ? "clockwise" : "anticlockwise"}` : "";
  label(g, `${words}${Math.hypot(...now).toFixed(1)} m/s from ${POINTS[Math.round(from / 45) % 8]} (${from}°)${turns}`, 46, 24, "left", "middle");
}

function arrow(g, [x, y], wind, css, width) {
  g.save();
  g.translate(x, y);
  g.rotate(Math.atan2(wind[1], -wind[0])); // air moves to −wind; the canvas has y down
  Object.assign(g, { strokeStyle: css, fillStyle: css, lineWidth: width });
  g.beginPath();
  g.moveTo(-13, 0);
  g.lineTo(9, 0);
  g.stroke();
  g.beginPath();
  g.moveTo(14, 0);
  g.lineTo(5, -5);
  g.lineTo(5, 5);
  g.fill();
  g.restore();
}

/** A picture of people's own beneath everything. */
export function picture(g, view, { image, west, south, width, height }) {
  g.globalAlpha = 0.6;
  g.drawImage(image, view.x(west), view.y(south + height), width * view.scale, height * view.scale);
  g.globalAlpha = 1;
}

export function walls(g, view, outlines) {
  g.fillStyle = faded("muted", 0.45);
  g.strokeStyle = colours.ink.css;
  g.lineWidth = 1;
  for (const outline of outlines) {
    around(g, view, outline);
    g.fill();
    g.stroke();
  }
}

/** The outline that no way leaves. */
export function fence(g, view, outline) {
  if (!outline.length) return;
  around(g, view, outline);
  g.setLineDash([8, 4]);
  haloed(g, colours.ink.css, 1.5);
  g.setLineDash([]);
}

function around(g, view, outline) {
  g.beginPath();
  for (const [x, y] of outline) g.lineTo(view.x(x), view.y(y));
  g.closePath();
}

export function particles(g, view, values, large) {
  const count = values.length / 3;
  if (!count) return;
  const size = large ? 3 : Math.min(3.5, Math.max(2, Math.min(view.width, view.height) / 200)), half = size / 2;
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

export function track(g, view, places, pale) {
  if (places.length < 4) return;
  g.beginPath();
  for (let i = 0; i < places.length; i += 2) g.lineTo(view.x(places[i]), view.y(places[i + 1]));
  haloed(g, pale ? colours.muted.css : colours.ink.css, pale ? 1.2 : 1.6);
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

/** Which colour of a gauge a reading has: 0 is noise, then 1, 2, … */
export function level({ edges, falls }, gas) {
  return edges.filter((edge) => (falls ? gas <= edge : gas >= edge)).length;
}

export function readings(g, view, rows, gauge) {
  g.lineWidth = 1;
  for (const [, , x, y, gas] of rows) {
    const at = gauge ? level(gauge, gas) : 0;
    g.beginPath();
    g.arc(view.x(x), view.y(y), gauge && !at ? 3 : 5, 0, 2 * Math.PI);
    g.fillStyle = gauge ? (at ? colours[`gas-${at}`].css : colours.noise.css) : faded("reading", 0.85);
    g.fill();
    g.strokeStyle = gauge && !at ? colours.muted.css : colours.ink.css;
    g.stroke();
  }
}

export function waypoint(g, view, { waypoint: place, craft }) {
  if (!place) return;
  const [x, y] = [view.x(place[0]), view.y(place[1])];
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

export function home(g, view, { craft }) {
  const [east, north] = craft?.home ?? [0, 0], [x, y] = [view.x(east), view.y(north)];
  if (!Number.isFinite(east)) return; // it was first heard in flight
  g.beginPath();
  for (const [dx, dy] of [[-7, 0], [0, -7], [7, 0]]) g.lineTo(x + dx, y + dy);
  g.moveTo(x - 5, y - 1);
  for (const [dx, dy] of [[-5, 6], [5, 6], [5, -1]]) g.lineTo(x + dx, y + dy);
  haloed(g, colours.ink.css, 1.6);
}

export function estimate(g, view, { x, y, ellipse: [longer, shorter, angle] }) {
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

export function source(g, view, [x, y]) {
  const [px, py] = [view.x(x), view.y(y)];
  g.beginPath();
  g.arc(px, py, 9, 0, 2 * Math.PI);
  haloed(g, colours.truth.css, 2.4);
  g.beginPath();
  g.arc(px, py, 2.8, 0, 2 * Math.PI);
  g.fillStyle = colours.truth.css;
  g.fill();
}

export function craft(g, view, { x, y, heading }, pale) {
  const css = pale ? colours.muted.css : colours.ink.css;
  g.save();
  g.translate(view.x(x), view.y(y));
  g.beginPath();
  if (heading === null) g.arc(0, 0, 6, 0, 2 * Math.PI);
  else {
    g.rotate(-heading);
    for (const [dx, dy] of [[12, 0], [-8, -7.5], [-4, 0], [-8, 7.5]]) g.lineTo(dx, dy);
    g.closePath();
  }
  haloed(g, css, 2);
  g.fillStyle = css;
  g.fill();
  g.restore();
}

/** A name beside its vehicle, within the window's width, above those that are there already: [left, bottom, right] px. */
export function name(g, view, { x, y }, text, there) {
  const wide = g.measureText(text).width, fits = view.x(x) + 12 + wide < g.canvas.clientWidth;
  const left = view.x(x) + (fits ? 12 : -12 - wide), right = left + wide;
  let bottom = view.y(y) - 12;
  while (there.some(([from, at, to]) => left < to + APART && right > from - APART && Math.abs(at - bottom) < LINE)) bottom -= LINE;
  there.push([left, bottom, right]);
  label(g, text, left, bottom, "left", "bottom");
}
