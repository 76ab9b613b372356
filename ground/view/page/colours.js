// The colours of canvas and charts, read from the style sheet, in light or dark. Okabe and Ito's palette: safe for colour-blind eyes.

const NAMES = ["paper", "card", "ink", "muted", "grid", "belief", "estimate", "waypoint", "reading", "truth", "noise", "gas-1", "gas-2", "gas-3", "gas-4", "gas-5"];

/** The colours that hold now, each as {css, rgb}. */
export const colours = {};

const probe = document.createElement("span");
probe.hidden = true;

/** Read the colours anew. */
export function readColours() {
  if (!probe.isConnected) document.body.append(probe);
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    const css = getComputedStyle(probe).color;
    colours[name] = { css, rgb: css.match(/\d+(\.\d+)?/g).slice(0, 3).map(Number) };
  }
}

/** The same colour, more or less opaque. */
export function faded(name, alpha) {
  return `rgba(${colours[name].rgb.join(",")},${alpha})`;
}

const dark = matchMedia("(prefers-color-scheme: dark)");

/** Follow the system, the button, and what was chosen before; `changed` is called after each change. */
export function followTheme(button, changed) {
  const root = document.documentElement;
  const kept = recall();
  if (kept) root.dataset.theme = kept;
  const update = () => { readColours(); changed(); };
  dark.addEventListener("change", update);
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("theme", root.dataset.theme); } catch { /* private window: not kept */ }
    update();
  });
  readColours();
}

function recall() {
  try { return localStorage.getItem("theme"); } catch { return null; }
}

/** Whether the page is dark now. */
export function isDark() {
  return (document.documentElement.dataset.theme ?? (dark.matches ? "dark" : "light")) === "dark";
}
