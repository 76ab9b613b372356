// A pane shows one vehicle: a sentence, what may be done, the map, what a pilot looks for, charts, and all else when it is asked for.

import { Charts } from "./charts.js";
import { Controls } from "./controls.js";
import { fillLegend } from "./legend.js";
import { WorldMap } from "./map.js";
import { newest } from "./model.js";
import { duration, make, modeOf, seconds, sentence, setText, stopInWords } from "./words.js";

const SIGNS = { ok: "✓", missing: "✕", starting: "…", stale: "!", refusing: "!" };
const LEVELS = { info: "·", warning: "!", error: "✕", stop: "■" };
const STATES = { found: "✓", false: "✕", outside: "↗", spent: "!", paused: "❚❚", pilot: "❚❚", lost: "✕", stuck: "✕", doubtful: "?", returning: "↩", landing: "↓", over: "■" };
const MOST_ROWS = 200;
const LOW = 0.25, EMPTY = 0.12; // shares of charge, as in scene/state.py
const QUIET_S = 2, SILENT_S = 3; // since the vehicle was heard
const LOSSY = 0.02; // share of what is sent to the vehicle that does not arrive

export class Pane {
  /** on: {draw(): draw again, command(name, vehicle), seek(time_s), aloud(text)}. */
  constructor(name, on) {
    this.name = name;
    this.on = on;
    this.root = document.getElementById("pane").content.firstElementChild.cloneNode(true);
    this.find = (selector) => this.root.querySelector(selector);
    this.facts = Object.fromEntries([...this.root.querySelectorAll("[data-fact]")].map((element) => [element.dataset.fact, element]));
    this.controls = new Controls(this.find(".operator"), (command) => on.command(command, name));
    this.find(".copy").addEventListener("click", () => this.copy());
    this.announced = null;
    this.shownServices = "";
    this.lost = "";
  }

  /** Begin to draw, once the pane is on the page. */
  begin() {
    const { find } = this;
    this.map = new WorldMap(find("canvas"), this.on.draw, (text) => setText(find(".pointer"), text));
    this.charts = new Charts(find(".charts"), find(".more-charts"), find(".chart-marks"), (words) => setText(find(".mark-words"), words));
    find(".more").addEventListener("toggle", ({ target }) => { if (target.open) this.charts.open(); });
    const look = (button, change) => find(button).addEventListener("click", () => { change(); this.on.draw(); });
    look(".zoom-in", () => this.map.camera.zoom(this.map.view, 1.5));
    look(".zoom-out", () => this.map.camera.zoom(this.map.view, 1 / 1.5));
    look(".to-belief", () => { this.map.camera.mode = "belief"; });
    look(".to-all", () => { this.map.camera.mode = "all"; });
    find(".picture-open").addEventListener("click", () => this.on.picture(this.map));
    find(".legend-fold").open = matchMedia("(min-width: 79rem) and (min-aspect-ratio: 3/2)").matches; // there it lies beside the area
  }

  /** Look at the belief, or at all. */
  look(mode) {
    this.map.camera.mode = mode;
    this.on.draw();
  }

  copy() {
    const button = this.find(".copy");
    const told = (text) => { setText(button, text); setTimeout(() => setText(button, "Copy coordinates"), 2000); };
    (navigator.clipboard?.writeText(button.dataset.copy) ?? Promise.reject()).then(() => told("Copied"), () => told(button.dataset.copy));
  }

  /** What is known of the vehicle besides its scenes: its entry in the list, null if it is unknown. */
  describe(vehicle, alone) {
    const gone = vehicle && !vehicle.here;
    setText(this.find(".title"), [this.name, vehicle?.title, gone ? "gone" : ""].filter(Boolean).join(" · "));
    this.root.classList.toggle("gone", Boolean(gone));
    this.find(".title").classList.toggle("hidden", alone && !gone);
    this.root.setAttribute("aria-label", `Vehicle ${this.name}`);
    this.find(".operator").setAttribute("aria-label", `Operator of ${this.name}`);
    this.gone = gone;
    this.find(".findings").hidden = !vehicle?.findings;
    if (vehicle?.findings) this.find(".findings").href = vehicle.findings;
  }

  /** Allow commands, or say why not; `lost`: what the sentence says instead while the page has no connection. */
  allow(whyNot, lost) {
    this.controls.allow(whyNot);
    this.lost = lost;
  }

  /** Show what became of a command. */
  answer(text, level) {
    this.controls.answer(text, level);
  }

  /** Draw all. context: {other: model beside it or null, others: models on the same map, last_s, moments: rows or null, at_s, redraw}. */
  draw(model, context) {
    const { scene } = model;
    if (!scene) return;
    this.drawState(scene, context.moments !== null, context.others.length > 0 || Boolean(context.other));
    this.drawFacts(scene, newest(model));
    this.controls.draw(scene);
    this.map.draw(model, context.others);
    for (const mode of ["belief", "all"]) this.find(`.to-${mode}`).setAttribute("aria-pressed", String(this.map.camera.mode === mode));
    this.find(".to-belief").disabled = !scene.estimate;
    fillLegend(this.find(".legend"), scene, model, context.others);
    if (model.fresh.measurements || model.fresh.happenings || context.other?.fresh.measurements || context.redraw) {
      this.charts.draw(model, context.other, context.last_s, context.moments ?? model.happenings);
    }
    this.drawServices(scene.services);
    if (context.moments) this.drawMoments(context.moments, context.at_s);
    else if (model.fresh.happenings || context.redraw) this.drawHappenings(model.happenings);
  }

  drawState(scene, isRecord, several) {
    const { kind, level, text, notes, copy } = this.lost ? { kind: "lost", level: "bad", text: this.lost, notes: [], copy: "" } : this.gone ? { ...scene.state, notes: ["the vehicle is gone", ...scene.state.notes] } : scene.state;
    const place = this.find(".state");
    Object.assign(place.dataset, { level, kind });
    setText(this.find(".state .sign"), STATES[kind] ?? "●");
    setText(this.find(".sentence"), [isRecord && `Replay, ${seconds(scene.time_s)}. `, several && `${this.name}: `, text].filter(Boolean).join(""));
    setText(this.find(".notes"), sentence(notes.join(" · ")));
    this.find(".copy").hidden = !copy;
    this.find(".copy").dataset.copy = copy;
  }

  drawFacts(scene, row) {
    const { craft, state } = scene, [flies, meaning] = modeOf(craft?.mode);
    const metres = (value, digits = 0) => (Number.isFinite(value) ? `${value.toFixed(digits)} m` : "–");
    const silent = scene.silent_s ?? null, lost = craft?.lost ?? 0;
    const radio = craft?.radio?.map((end) => end ?? "–").join(" / "); // signal strength at both ends
    const facts = {
      flies,
      altitude: craft && Number.isFinite(craft.x) ? metres(craft.altitude_m, 1) : "–",
      speed: Number.isFinite(craft?.speed_mps) ? `${craft.speed_mps.toFixed(1)} m/s` : "–",
      battery: Number.isFinite(craft?.battery) ? `${Math.round(100 * craft.battery)}%` : "–",
      volts: Number.isFinite(craft?.volts) ? `${craft.volts.toFixed(1)} V` : "–",
      home: metres(craft?.home_m),
      link: silent === null ? "–" : silent >= QUIET_S ? `silent ${silent.toFixed(0)} s` : lost < LOSSY ? (radio ?? "good") : `${Math.round(100 * lost)}% lost`,
      moves: row ? `${row.step}${state.moves_left === null ? "" : ` of ≈${row.step + state.moves_left}`}` : "–",
      left: state.seconds_left === null ? "–" : `≈ ${duration(state.seconds_left)}`,
      mode: craft?.mode || "–",
      armed: craft?.armed === true ? "yes" : craft?.armed === false ? "no" : "–",
      radio: radio ?? "–",
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
    this.facts.flies.title = meaning;
    setText(this.find(".mode-meaning"), meaning);
    this.find(".intermittency").hidden = !scene.gas;
    mark(this.facts.advice, scene.gas?.advised_dwell_s && "warn");
    mark(this.facts.gps, /^no /.test(facts.gps) && "warn");
    mark(this.facts.health, !["ok", "–"].includes(facts.health) && "warn");
    mark(this.facts.battery, craft?.battery <= EMPTY && craft.battery !== null ? "bad" : craft?.battery <= LOW && craft.battery !== null && "warn");
    mark(this.facts.link, silent >= SILENT_S ? "bad" : (silent >= QUIET_S || lost >= LOSSY) && "warn");
    mark(this.facts.flies, flies.startsWith("pilot") && "warn");
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

function mark(element, level) {
  if (level) element.dataset.level = level;
  else delete element.dataset.level;
}
