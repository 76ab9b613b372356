// A pane shows one vehicle: facts, outcome, map, charts, services, what happened, and the operator's commands.

import { Charts } from "./charts.js";
import { WorldMap } from "./map.js";
import { newest } from "./model.js";

const SIGNS = { ok: "✓", missing: "✕", starting: "…", stale: "!", refusing: "!" };
const LEVELS = { info: "·", warning: "!", error: "✕", stop: "■" };
const ENDINGS = { located: ["✓", "Located", "good"], outside: ["↗", "Outside the area", "warn"], "FALSE STOP": ["✕", "False stop", "bad"], ceased: ["■", "Ceased", "calm"], "not ceased": ["!", "Not ceased", "warn"] };
const LEADING = ["taking off", "searching"]; // the uav's states in which the search leads
const MOST_ROWS = 200;

/** Set a text only where it differs, so that nothing is laid out in vain. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function make(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

export function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

export function seconds(time_s) {
  return `${time_s.toFixed(1)} s`;
}

export class Pane {
  /** on: {draw(): draw again, command(name, vehicle), seek(time_s), aloud(text)}. */
  constructor(name, on) {
    this.name = name;
    this.on = on;
    this.root = document.getElementById("pane").content.firstElementChild.cloneNode(true);
    this.find = (selector) => this.root.querySelector(selector);
    this.facts = Object.fromEntries([...this.root.querySelectorAll("[data-fact]")].map((element) => [element.dataset.fact, element]));
    for (const button of this.root.querySelectorAll("[data-command]")) {
      button.addEventListener("click", () => on.command(button.dataset.command, name));
    }
    this.announced = null;
    this.shownServices = "";
    this.whyNot = "";
    this.leads = false;
  }

  /** Begin to draw, once the pane is on the page. */
  begin() {
    this.map = new WorldMap(this.find("canvas"), this.on.draw);
    this.charts = new Charts(this.find(".spread"), this.find(".gas"), this.find(".spread-title"), this.find(".gas-title"));
  }

  /** What is known of the vehicle besides its scenes: its entry in the list, null if it is unknown. */
  describe(vehicle, alone) {
    const gone = vehicle && !vehicle.here;
    setText(this.find(".title"), [this.name, vehicle?.title, gone ? "gone" : ""].filter(Boolean).join(" · "));
    this.root.classList.toggle("gone", Boolean(gone));
    this.find(".title").classList.toggle("hidden", alone && !gone);
    this.root.setAttribute("aria-label", `Vehicle ${this.name}`);
  }

  /** Allow commands, or say why not. */
  allow(whyNot) {
    this.whyNot = whyNot;
    this.drawButtons();
    const why = this.find(".why");
    why.hidden = !whyNot;
    setText(why, sentence(whyNot));
  }

  /** While the search leads there is nothing to give back to it. */
  drawButtons() {
    for (const button of this.root.querySelectorAll("[data-command]")) {
      button.disabled = Boolean(this.whyNot) || (button.dataset.command === "resume" && this.leads);
    }
  }

  /** Show what became of a command. */
  answer(text, level) {
    const place = this.find(".answer");
    place.dataset.level = level;
    setText(place, text);
  }

  /** Draw all. context: {other: model or null, last: step or null, moments: rows or null, at_s}. */
  draw(model, context) {
    const { scene } = model;
    if (!scene) return;
    const row = newest(model), { craft } = scene;
    const facts = {
      mode: craft?.mode || "–",
      armed: craft?.armed === true ? "yes" : craft?.armed === false ? "no" : "–",
      battery: charge(craft),
      gps: craft?.gps || "–",
      health: craft?.health || "–",
      time: seconds(scene.time_s),
      step: row ? String(row.step) : "–",
      spread: row ? `${row.spread_m.toFixed(2)} m` : "–",
      stop: stopInWords(scene.stop),
      assume: scene.assume || "–",
      ...intermittency(scene.gas),
    };
    for (const [name, text] of Object.entries(facts)) setText(this.facts[name], text);
    this.find(".intermittency").hidden = !scene.gas;
    mark(this.facts.advice, Boolean(scene.gas?.advised_dwell_s));
    mark(this.facts.gps, /^no /.test(facts.gps));
    mark(this.facts.health, !["ok", "–"].includes(facts.health));
    const leads = LEADING.includes(scene.services.find(({ name }) => name === "uav")?.state);
    if (leads !== this.leads) {
      this.leads = leads;
      this.drawButtons();
    }
    this.drawEnding(scene.ending);
    this.map.draw(model);
    this.drawLegend(scene, model.plume);
    if (model.fresh.measurements || context.other?.fresh.measurements || context.redraw) this.charts.draw(model, context.other, context.last);
    this.drawServices(scene.services);
    if (context.moments) this.drawMoments(context.moments, context.at_s);
    else if (model.fresh.happenings || context.redraw) this.drawHappenings(model.happenings);
  }

  drawEnding(ending) {
    const place = this.find(".ending");
    place.hidden = !ending;
    if (!ending || place.dataset.verdict + place.dataset.text === ending.verdict + ending.text) return;
    const [sign, words, level] = ENDINGS[ending.verdict] ?? ["■", ending.verdict, "calm"];
    Object.assign(place.dataset, { level, verdict: ending.verdict, text: ending.text });
    const mark = make("span", "sign", sign);
    mark.setAttribute("aria-hidden", "true");
    place.replaceChildren(mark, make("strong", "", words), " ", make("span", "", ending.text));
  }

  drawLegend({ truth }, plume) {
    for (const item of this.root.querySelectorAll(".of-truth")) item.hidden = !truth || (item.matches(".of-plume") && !plume);
    if (truth && plume) setText(this.find(".ramp-text"), `true gas: ${oneDigit(plume.most / 1000)} to ${oneDigit(plume.most)} g/m³, log scale`);
  }

  drawServices(services) {
    const key = JSON.stringify(services);
    if (key === this.shownServices) return;
    this.shownServices = key;
    this.find(".services").replaceChildren(...services.map((service) => {
      const item = make("li");
      item.dataset.verdict = service.verdict;
      const sign = make("span", "sign", SIGNS[service.verdict] ?? "?");
      sign.setAttribute("aria-hidden", "true");
      const latency = service.latency_s > 0 ? `${(1000 * service.latency_s).toFixed(service.latency_s < 0.01 ? 1 : 0)} ms` : "";
      item.append(sign, make("strong", "", service.name), make("span", "verdict", service.verdict), make("span", "latency figure", latency));
      const about = [service.state, service.about, service.step >= 0 ? `step ${service.step}` : ""].filter(Boolean).join(" · ");
      if (about) item.append(make("span", "about", about));
      for (const warning of service.warnings) item.append(make("span", "warning", `! ${warning}`));
      return item;
    }));
    if (!services.length) this.find(".services").replaceChildren(make("li", "none", "None heard yet."));
  }

  drawHappenings(rows) {
    const shown = rows.slice(-MOST_ROWS).reverse();
    this.find(".happenings").replaceChildren(...shown.map((row) => happening(make("li"), row)));
    if (this.announced !== null) {
      for (const [, level, who, text] of rows.slice(this.announced)) if (level !== "info") this.on.aloud(`${this.name}, ${who}: ${text}`);
    }
    this.announced = rows.length;
  }

  /** All that happens in a record; what is still to come is pale. */
  drawMoments(rows, at_s) {
    const list = this.find(".happenings");
    if (this.moments !== rows) {
      this.moments = rows;
      list.replaceChildren(...rows.map((row) => {
        const button = happening(make("button"), row);
        button.type = "button";
        button.addEventListener("click", () => this.on.seek(row[0]));
        const item = make("li");
        item.append(button);
        return item;
      }));
    }
    const past = rows.filter(([time_s]) => time_s <= at_s).length;
    if (past === this.past && list.dataset.past) return;
    this.past = list.dataset.past = past;
    [...list.children].forEach((item, i) => item.classList.toggle("future", i >= past));
    const current = list.children[Math.max(0, past - 1)];
    if (current) list.scrollTop = current.offsetTop - list.offsetTop - list.clientHeight / 2;
  }
}

function happening(element, [time_s, level, who, text]) {
  element.classList.add("happening");
  element.dataset.level = level;
  const sign = make("span", "sign", LEVELS[level] ?? "·");
  sign.setAttribute("aria-hidden", "true");
  element.append(make("span", "time figure", seconds(time_s)), sign, make("strong", "", who), make("span", "text", text));
  return element;
}

/** What is left in the battery, as far as the vehicle says it. */
function charge(craft) {
  const share = Number.isFinite(craft?.battery) ? `${Math.round(100 * craft.battery)}%` : "";
  const volts = Number.isFinite(craft?.volts) ? `${craft.volts.toFixed(1)} V` : "";
  return [share, volts].filter(Boolean).join(", ") || "–";
}

/** How the gas comes and goes, by the belief. */
function intermittency(gas) {
  const told = (name, digits, unit = "") => {
    const values = gas?.intermittency[name]?.map((value) => String(Number(value.toPrecision(digits))));
    return values ? `${values[1]}${unit} (${values[0]} to ${values[2]})` : "";
  };
  const share = told("puff-share", 1);
  return {
    downwind: told("downwind", 2) && `cv ${told("downwind", 2)}`,
    cv: told("cv", 2) ? `cv ${told("cv", 2)}` : "–",
    puffs: [told("puff-rate", 1, "/s"), share && `share ${share}`].filter(Boolean).join(", ") || "–",
    advice: gas?.advised_dwell_s ? `hover ${gas.advised_dwell_s} s for a reading` : "–",
  };
}

function mark(element, warns) {
  if (warns) element.dataset.level = "warn";
  else delete element.dataset.level;
}

const oneDigit = (value) => String(Number(value.toPrecision(1)));

/** `spread:0.5` for people. */
function stopInWords(stop) {
  const [kind, rest = ""] = (stop || "").split(":");
  if (kind === "spread") return `${rest} m spread`;
  if (kind === "within") {
    const [radius, share] = rest.split(",");
    return `${Math.round(100 * share)}% within ${radius} m`;
  }
  return stop || "–";
}
