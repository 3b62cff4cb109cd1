// The theme: light, dark, or as the system has it; and whether motion is welcome.

const KEPT = "lanemap.theme";
const NAMES = [
  "ground", "grid", "grid-major", "verge", "asphalt", "ribbon", "white-paint", "yellow-paint", "curb", "unknown-paint",
  "chosen", "truth", "appeared", "moved", "repainted", "vanished", "card", "accent", "ink", "ink-soft",
];
const system = matchMedia("(prefers-color-scheme: dark)");
const still = matchMedia("(prefers-reduced-motion: reduce)");
const listeners = [];

/** Calls back when the colours change. */
export function onTheme(listener) {
  listeners.push(listener);
}

export function isDark() {
  return (document.documentElement.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";
}

/** Changes between light and dark, and keeps the choice where it differs from the system's. */
export function switchTheme() {
  const wanted = isDark() ? "light" : "dark";
  if (wanted === (system.matches ? "dark" : "light")) {
    delete document.documentElement.dataset.theme;
    localStorage.removeItem(KEPT);
  } else {
    document.documentElement.dataset.theme = wanted;
    localStorage.setItem(KEPT, wanted);
  }
  tell();
}

/** A duration for those who like motion; 0 for others. */
export function moving(durationMs) {
  return still.matches ? 0 : durationMs;
}

/** The colours of the theme as it is now: the style sheet's variables, by their names. */
export function colours() {
  const probe = document.createElement("i");
  document.body.append(probe);
  const found = Object.fromEntries(NAMES.map((name) => {
    probe.style.color = `var(--${name})`;
    return [name, getComputedStyle(probe).color];
  }));
  probe.remove();
  return found;
}

function tell() {
  for (const listener of listeners) listener();
}

const kept = localStorage.getItem(KEPT);
if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
system.addEventListener("change", tell);
