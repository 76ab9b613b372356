// The legend of a map: what is on it, and the colours of readings with their numbers.

import { make, setText } from "./words.js";

const oneDigit = (value) => String(Number(value.toPrecision(1)));
const short = (value) => String(Number(value.toPrecision(2)));

/** Bring a legend up to date. */
export function fillLegend(list, { truth, gauge }, { plume, walls, fence }, others) {
  const shown = { truth: Boolean(truth), plume: Boolean(truth && plume), walls: walls.length > 0, fence: fence.length > 0, others: others.length > 0 };
  for (const [name, is] of Object.entries(shown)) for (const item of list.querySelectorAll(`.of-${name}`)) item.hidden = !is;
  if (truth && plume) setText(list.querySelector(".ramp-text"), `true gas: ${oneDigit(plume.most / 1000)} to ${oneDigit(plume.most)} g/m³, log scale`);
  const key = JSON.stringify(gauge);
  const place = list.querySelector(".gauge");
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  place.replaceChildren(...(gauge ? steps(gauge) : [make("span", "", "reading")]));
}

function steps({ unit, edges, falls }) {
  const words = edges.map((edge, i) => (falls ? `≤ ${short(edge)}` : i + 1 < edges.length ? `${short(edge)} to ${short(edges[i + 1])}` : `≥ ${short(edge)}`));
  const title = make("span", "gauge-title", `reading${unit ? `, ${unit}` : ""}`);
  return [title, step(0, falls ? `> ${short(edges[0])}: noise` : `< ${short(edges[0])}: noise`), ...words.map((text, i) => step(i + 1, text))];
}

function step(level, text) {
  const item = make("span", "gauge-step"), dot = make("i", `gauge-dot gas-${level}`);
  item.append(dot, text);
  return item;
}
