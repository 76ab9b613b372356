// Begins the page: what comes from the server is kept, and drawn once a frame; what people want is told to the server.

import { followTheme } from "./colours.js";
import { followKeys } from "./keys.js";
import { Link } from "./link.js";
import { merge, unknown, unpack } from "./model.js";
import { Pane } from "./pane.js";
import { followPicture } from "./picture.js";
import { TimeLine } from "./timeline.js";
import { followWord } from "./word.js";
import { make, sentence, setText } from "./words.js";

const MOST_LATENCIES = 2000;
const find = (id) => document.getElementById(id);

/** What the page knows and wants. Tests read it as window.plumeward. */
const state = {
  link: "connecting", // open, lost, over
  hello: null,
  vehicles: [],
  notice: "", // what the server wants people to know: there is no router, ...
  bye: "",
  why: "", // the reason that the server gave for closing the connection
  show: [], // names of the one or two that are shown
  truth: false,
  at_s: null, // the moment that is wanted of records
  models: {}, // by name
};
const panes = new Map();
const page = { state, panes, drawn: 0, latencies_ms: [], answers: [], line: null };
window.plumeward = page;

let undrawn = []; // [number, published_ms] of scenes that came and are not drawn yet
let asked = ""; // what was last said to be shown
let planned = false, all = true;

// ---- drawing ----

/** Draw with the next frame; `everything` also what did not change. */
function plan(everything = false) {
  all ||= everything;
  if (planned) return;
  planned = true;
  requestAnimationFrame(draw);
}

function draw() {
  planned = false;
  tellWanted();
  const shown = state.show.map((name) => state.models[name]);
  const last_s = Math.max(0, ...listed().map((vehicle) => vehicle.end_s ?? 0));
  shown.forEach((model, i) => {
    const vehicle = state.vehicles.find(({ name }) => name === model.name);
    const other = shown.length > 1 ? shown[1 - i] : null;
    const others = beside(model.name, i).map((name) => state.models[name]).filter((one) => one?.scene);
    panes.get(model.name).draw(model, {
      other: other?.scene ? other : null, others, last_s: last_s || null, moments: isRecord(vehicle) ? (vehicle.moments ?? []) : null, at_s: state.at_s, redraw: all,
    });
  });
  for (const model of shown) if (model.scene) model.fresh.measurements = model.fresh.happenings = false;
  all = false;
  if (undrawn.length) acknowledge(undrawn);
  undrawn = [];
}

/** Once the frame is out: the next scene may come. */
function acknowledge(scenes) {
  const { port1, port2 } = new MessageChannel();
  port1.onmessage = () => {
    for (const [number, published_ms] of scenes) {
      link.say({ drawn: number });
      page.drawn = number;
      if (published_ms) page.latencies_ms.push(Date.now() - published_ms);
    }
    page.latencies_ms.splice(0, page.latencies_ms.length - MOST_LATENCIES);
  };
  port2.postMessage(0);
}

// ---- what is shown ----

const isRecord = (vehicle) => vehicle?.end_s !== null && vehicle?.end_s !== undefined;
const listed = () => state.show.map((name) => state.vehicles.find((vehicle) => vehicle.name === name)).filter(Boolean);

/** The vehicles that have no pane and are on the map of a shown one as well: those of its search, and on the first pane all live ones. */
function beside(shown, pane) {
  const { search } = state.models[shown];
  return state.vehicles.filter((vehicle) => vehicle.here && !state.show.includes(vehicle.name) && (vehicle.search === search || (!pane && !isRecord(vehicle)))).map(({ name }) => name);
}

/** All that are on the map of another one. */
const aside = () => [...new Set(state.show.flatMap(beside))];

/** Tell the server what to send, where that is news. */
function tellWanted() {
  if (!state.show.length) return;
  const wanted = JSON.stringify({ show: state.show, beside: aside(), truth: state.truth, at_s: state.at_s });
  if (wanted !== asked && link.say(JSON.parse(wanted))) asked = wanted;
}

/** Show these vehicles. */
function show(names) {
  state.show = names;
  const place = find("panes");
  for (const [name, pane] of panes) {
    if (names.includes(name)) continue;
    pane.root.remove();
    panes.delete(name);
  }
  for (const name of names) {
    state.models[name] ??= unknown(name);
    if (panes.has(name)) continue;
    const pane = new Pane(name, { draw: () => plan(), command, seek: (time_s) => { page.line.pause(); page.line.go(time_s); }, aloud, picture: askPicture });
    panes.set(name, pane);
    place.append(pane.root);
    pane.begin();
  }
  for (const name of names) place.append(panes.get(name).root);
  place.classList.toggle("two", names.length > 1);
  arrange();
}

/** Bring all around the drawings up to date: choices, titles, what may be done. */
function arrange() {
  const [first, second = ""] = state.show;
  const option = (vehicle, chosen) => new Option([state.models[vehicle.name].label, vehicle.title, vehicle.here ? "" : "(gone)"].filter(Boolean).join(" · "), vehicle.name, false, vehicle.name === chosen);
  find("first").replaceChildren(...state.vehicles.map((vehicle) => option(vehicle, first)));
  find("second").replaceChildren(new Option("none", "", false, !second), ...state.vehicles.filter(({ name }) => name !== first).map((vehicle) => option(vehicle, second)));
  find("choose-first").hidden = !state.vehicles.length;
  find("choose-second").hidden = state.vehicles.length < 2;
  for (const [name, pane] of panes) {
    const vehicle = state.vehicles.find((other) => other.name === name);
    pane.describe(vehicle, state.show.length === 1);
    pane.allow(whyNot(vehicle), lostText());
  }
  const records = listed().filter(isRecord);
  page.line.show(records);
  if (!records.length) state.at_s = null;
  find("truth").hidden = !listed().some((vehicle) => vehicle.has_truth);
  find("truth").setAttribute("aria-pressed", String(state.truth));
  find("empty").hidden = state.show.length > 0;
  document.title = first ? `${state.show.join(", ")} · Plumeward` : "Plumeward";
  plan(true);
}

/** Why the vehicle cannot be commanded now; empty if it can. */
function whyNot(vehicle) {
  if (state.link !== "open") return state.link === "over" ? "The mission is over." : "There is no connection.";
  if (!state.hello.may_command) return state.hello.why_not || "Commands are not allowed here.";
  return vehicle?.here ? "" : "The vehicle is gone.";
}

/** What the sentence says while the page hears nothing of the mission; empty while it does. */
function lostText() {
  return state.link === "lost" ? `Lost link: this page has no connection, and shows how it was at ${new Date(state.lost_ms).toLocaleTimeString()}` : "";
}

// ---- what comes from the server ----

const link = new Link({
  hello(hello) {
    state.hello = hello;
    hearWord(hello.word);
    asked = "";
    state.bye = "";
    setText(find("empty-title"), hello.live ? "Waiting for a vehicle" : "Opening the record");
    setText(find("empty-text"), hello.live ? "None is heard yet. It appears here by itself. To fly a mission with a page of its own:" : "One moment.");
    find("empty-command").hidden = !hello.live;
    tellLink();
  },
  vehicles(vehicles, notice) {
    Object.assign(state, { vehicles, notice });
    tellLink();
    const known = state.show.filter((name) => state.models[name]?.scene || vehicles.some((vehicle) => vehicle.name === name));
    // Where there are others than those of one search, a name says of which it is.
    const alone = (search) => vehicles.every((each) => each.search === search);
    for (const { name, search } of vehicles) {
      state.models[name] ??= unknown(name);
      Object.assign(state.models[name], { search, label: name.startsWith(search) && alone(search) ? name.slice(search.length + 1) || name : name });
    }
    const first = vehicles.filter(({ search }, i) => vehicles.findIndex((other) => other.search === search) === i); // of each record, and of each search
    if (!known.length && vehicles.length) show(first.slice(0, isRecord(vehicles[0]) ? 2 : 1).map(({ name }) => name));
    else show(known);
  },
  scene(buffer) {
    const scene = unpack(buffer);
    const { number, vehicle, published_ms } = scene.header;
    undrawn.push([number, published_ms]);
    state.models[vehicle] ??= unknown(vehicle);
    merge(state.models[vehicle], scene);
    plan();
  },
  answer(answer) {
    page.answers.push(answer);
    const { vehicle, command: name, accepted, reason } = answer;
    const why = reason.replace(/^\w+ refused: /, ""); // the vehicle says what it refuses, as we do
    panes.get(vehicle)?.answer(`${TITLES[name] ?? name} ${accepted ? "accepted" : "refused"}${why ? `: ${why}` : ""}`, accepted ? "good" : "bad");
  },
  bye(text) {
    state.bye = text;
  },
  changed(now, why) {
    if (now === "lost" && state.link !== "lost") state.lost_ms = Date.now();
    Object.assign(state, { link: now, why });
    document.body.classList.toggle("lost", now === "lost");
    tellLink();
    arrange();
  },
});

/** Say how the connection is, in a word, and in a line above everything where people should know more. */
function tellLink() {
  const words = { connecting: ["connecting", "wait"], lost: ["no connection", "bad"], over: ["over", "calm"], open: state.hello?.live ? ["live", "good"] : ["record", "calm"] };
  const [text, level] = words[state.link];
  setText(find("link"), text);
  find("link").dataset.level = level;
  const notice = {
    lost: state.why ? `${sentence(state.why)}. Trying again…` : "Connection lost: this is the last picture. Connecting again…",
    over: `${sentence(state.bye)}. The last picture stays.`,
  }[state.link] ?? sentence(state.notice);
  find("notice").hidden = !notice;
  find("notice").dataset.level = { lost: "bad", over: "calm" }[state.link] ?? "warn";
  setText(find("notice"), notice);
}

/** Say something to who listens to the page. */
function aloud(text) {
  const log = find("aloud");
  log.append(make("p", "", text));
  while (log.children.length > 5) log.firstChild.remove();
}

// ---- what people want ----

const TITLES = { hold: "Pause", resume: "Resume", return: "Return", land: "Land" };

function command(name, vehicle = state.show[0]) {
  const pane = panes.get(vehicle);
  if (!pane?.controls.can(name)) return;
  if (name === "land") return confirmLand(vehicle);
  send(name, vehicle);
}

function send(name, vehicle) {
  if (link.say({ command: name, vehicle })) panes.get(vehicle).answer(`${TITLES[name]} asked…`, "wait");
}

function confirmLand(vehicle) {
  const dialog = find("land");
  setText(find("land-text"), `${vehicle} ends its search and lands where it is. The search cannot be resumed.`);
  dialog.returnValue = "no";
  dialog.onclose = () => { if (dialog.returnValue === "yes") send("land", vehicle); };
  dialog.showModal();
}

function toggleTruth() {
  if (find("truth").hidden) return;
  state.truth = !state.truth;
  arrange();
}

const askPicture = followPicture(find("picture"), () => plan());
page.line = new TimeLine((time_s) => { state.at_s = time_s; plan(); });
const hearWord = followWord(find("word-open"), find("word"), () => link.again());
followTheme(find("theme"), () => plan(true));
followKeys({
  replay: () => listed().some(isRecord), line: page.line, command, truth: toggleTruth,
  look: (mode) => panes.get(state.show[0])?.look(mode), theme: () => find("theme").click(), help: () => find("help").showModal(),
});
find("truth").addEventListener("click", toggleTruth);
find("help-open").addEventListener("click", () => find("help").showModal());
find("first").addEventListener("change", ({ target }) => show([target.value, ...state.show.slice(1).filter((name) => name !== target.value)]));
find("second").addEventListener("change", ({ target }) => show([state.show[0], ...(target.value ? [target.value] : [])]));
