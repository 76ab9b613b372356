// Keys: what each does, and the table of them in the help.

import { make } from "./words.js";

/** page: {replay(): bool, line: TimeLine, command(name), look(mode), truth(), theme(), help()}. */
export function followKeys(page) {
  const { line } = page;
  const keys = [
    // key, shown as, what it does, where it holds, action
    [" ", "Space", "play or pause a record", "replay", () => line.toggle()],
    ["ArrowLeft", "←", "previous reading", "replay", () => line.jump("readings_s", -1)],
    ["ArrowRight", "→", "next reading", "replay", () => line.jump("readings_s", 1)],
    ["Shift+ArrowLeft", "Shift ←", "previous event", "replay", () => line.jump("events_s", -1)],
    ["Shift+ArrowRight", "Shift →", "next event", "replay", () => line.jump("events_s", 1)],
    ["Home", "Home", "begin of the record", "replay", () => { line.pause(); line.go(line.span[0]); }],
    ["End", "End", "end of the record", "replay", () => { line.pause(); line.go(line.span[1]); }],
    ["+", "+", "play faster", "replay", () => line.notch(1)],
    ["-", "−", "play slower", "replay", () => line.notch(-1)],
    ["b", "B", "the map: to the belief", "", () => page.look("belief")],
    ["a", "A", "the map: all", "", () => page.look("all")],
    ["", "+ − arrows", "the map: zoom and move, while it has the focus", "", () => {}],
    ["h", "H", "pause: stay where it is", "live", () => page.command("hold")],
    ["r", "R", "resume the search", "live", () => page.command("resume")],
    ["t", "T", "true plume of a simulation, on or off", "", () => page.truth()],
    ["d", "D", "light or dark", "", () => page.theme()],
    ["?", "?", "this help", "", () => page.help()],
  ];
  const rows = keys.map(([, shown, does, where]) => {
    const row = make("tr"), head = make("th");
    head.scope = "row";
    head.append(make("kbd", "", shown));
    row.append(head, make("td", "", does), make("td", "where", where ? (where === "replay" ? "records" : "live") : ""));
    return row;
  });
  document.getElementById("help-keys").replaceChildren(...rows);

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat && !event.key.startsWith("Arrow")) return;
    if (document.querySelector("dialog[open]") || event.target.closest("select, input:not([type=range]), textarea")) return;
    if (event.key === " " && event.target.closest("button")) return; // presses that button
    const shifted = event.shiftKey && event.key.startsWith("Arrow") ? `Shift+${event.key}` : event.key;
    const found = keys.find(([key, , , where]) => (key === shifted || key === shifted.toLowerCase()) && (!where || (where === "replay") === page.replay()));
    if (!found) return;
    event.preventDefault();
    found[4]();
  });
}
