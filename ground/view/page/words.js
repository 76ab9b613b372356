// Words for what the vehicle and the search say: plain ones, and what the terms mean.

/** What a flight mode is in plain words, and what it means. */
export const MODES = {
  OFFBOARD: ["search", "The search leads the vehicle: PX4 calls this mode OFFBOARD."],
  GUIDED: ["search", "The search leads the vehicle: ArduPilot calls this mode GUIDED."],
  HOLD: ["hold", "The vehicle stays where it is."], BRAKE: ["hold", "The vehicle stays where it is."], LOITER: ["pilot: loiter", "A pilot's mode: it stays where the pilot leaves it."],
  TAKEOFF: ["takeoff", "The vehicle climbs to its height."], RETURN: ["return", "The vehicle flies home and lands."], RTL: ["return", "The vehicle flies home and lands."],
  SMART_RTL: ["return", "The vehicle flies home the way it came, and lands."], AUTO_RTL: ["return", "The vehicle flies home and lands."], LAND: ["land", "The vehicle lands where it is."],
  MISSION: ["plan", "The vehicle flies the waypoints of an uploaded plan."], AUTO: ["plan", "The vehicle flies the waypoints of an uploaded plan."],
};

export function modeOf(mode) {
  return MODES[mode] ?? (mode ? [`pilot: ${mode.toLowerCase()}`, "A mode that only pilots fly: the search waits."] : ["–", ""]);
}

/** `spread:0.5` for people. */
export function stopInWords(stop) {
  const [kind, rest = ""] = (stop || "").split(":");
  if (kind === "spread") return `${rest} m spread`;
  if (kind === "within") {
    const [radius, share] = rest.split(",");
    return `${Math.round(100 * share)}% within ${radius} m`;
  }
  return stop || "–";
}

/** Where metres east and north of home are, WGS84. Good to a centimetre within a kilometre. */
export function coordinates([latitude, longitude], east, north) {
  const degrees = 180 / Math.PI / 6371000;
  const [lat, lon] = [latitude + north * degrees, longitude + (east * degrees) / Math.cos((latitude * Math.PI) / 180)];
  return `${Math.abs(lat).toFixed(6)} ${lat < 0 ? "S" : "N"}, ${Math.abs(lon).toFixed(6)} ${lon < 0 ? "W" : "E"}`;
}

/** How far another home lies from this one, [east, north] m; nowhere else while one of them is not known. */
export function away(home, other) {
  if (!home || !other) return [0, 0];
  const metres = (Math.PI / 180) * 6371000;
  return [(other[1] - home[1]) * metres * Math.cos((home[0] * Math.PI) / 180), (other[0] - home[0]) * metres];
}

/** A time for people: 24 s, 3 min 20 s. */
export function duration(time_s) {
  return time_s < 100 ? `${Math.round(time_s)} s` : `${Math.floor(time_s / 60)} min ${String(Math.round(time_s % 60)).padStart(2, "0")} s`;
}

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
