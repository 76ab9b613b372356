// The operator's buttons: only what is possible now can be pressed, and each says what it will do.

import { sentence, setText } from "./words.js";

const LEADING = ["taking off", "searching"]; // the uav's states in which the search leads
const STALE_MS = 8000; // an answer is gone after this

export class Controls {
  /** press(command): hold, resume, return or land. */
  constructor(root, press) {
    this.root = root;
    this.buttons = Object.fromEntries([...root.querySelectorAll("[data-command]")].map((button) => [button.dataset.button, button]));
    this.whyNot = "";
    this.scene = null;
    for (const button of Object.values(this.buttons)) button.addEventListener("click", () => press(button.dataset.command));
  }

  /** Allow commands, or say why not. */
  allow(whyNot) {
    this.whyNot = whyNot;
    const why = this.root.querySelector(".why");
    why.hidden = !whyNot;
    setText(why, sentence(whyNot));
    this.update();
  }

  draw(scene) {
    this.scene = scene;
    this.update();
  }

  /** What each button cannot do now, and why; empty where it can. */
  reasons() {
    const { scene } = this, uav = scene?.services.find(({ name }) => name === "uav");
    const mode = scene?.craft?.means ?? "", state = uav?.verdict === "ok" ? uav.state : "";
    const leads = LEADING.includes(state), grounded = scene?.craft?.armed === false ? "The vehicle is on the ground" : "";
    const held = state === "paused" && (mode === "HOLD" || mode === "");
    const over = scene?.ending ? "The search is over" : scene?.left ? "It has left the search" : "";
    return {
      held,
      hold: grounded || over || (state && !leads ? "The search does not lead now" : ""),
      resume: grounded || over || (leads ? "The search leads already" : ""),
      return: grounded || (mode === "RETURN" ? "It returns already" : ""),
      land: grounded || (mode === "LAND" ? "It lands already" : ""),
      back: grounded || over || (leads ? "The search leads already" : held ? "Resume does it" : ""),
    };
  }

  /** Whether a command can be given now. */
  can(command) {
    return [...this.root.querySelectorAll(`[data-command="${command}"]`)].some((button) => !button.disabled);
  }

  update() {
    const reasons = this.reasons();
    for (const [name, button] of Object.entries(this.buttons)) {
      button.disabled = Boolean(this.whyNot || reasons[name]);
      button.title = [button.dataset.says, reasons[name] && `${reasons[name]}.`].filter(Boolean).join(" ");
    }
    this.buttons.hold.hidden = reasons.held;
    this.buttons.resume.hidden = !reasons.held;
  }

  /** Show what became of a command; it goes when it is stale. */
  answer(text, level) {
    const place = this.root.querySelector(".answer");
    place.dataset.level = level;
    setText(place, text);
    clearTimeout(this.stale);
    if (level !== "wait") this.stale = setTimeout(() => setText(place, ""), STALE_MS);
  }
}
