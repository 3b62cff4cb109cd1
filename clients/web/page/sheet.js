// The panel's size: open or small on a desk; on a phone a sheet with three heights, dragged or stepped through.

const PHONE = matchMedia("(max-width: 699px)");
const panel = document.getElementById("panel");
const grip = document.getElementById("grip");
const HEIGHTS = ["peek", "half", "full"];

/** Shows the panel at one of its heights. */
export function setDetent(detent) {
  panel.dataset.detent = detent;
  grip.setAttribute("aria-expanded", String(detent !== "peek"));
  tellHeight();
}

/** Opens the panel where it is small, and the other way round. */
export function togglePanel() {
  setDetent(panel.dataset.detent === "peek" ? "half" : "peek");
}

/** What lies over the sheet is told how high it is. */
function tellHeight() {
  const covered = panel.dataset.detent === "full" ? 0 : panel.getBoundingClientRect().height;
  document.body.style.setProperty("--sheet-height", `${covered}px`);
  document.body.style.setProperty("--bar-height", `${document.getElementById("bar").getBoundingClientRect().height}px`);
}

let dragged;
grip.addEventListener("pointerdown", ({ pointerId, clientY }) => {
  if (!PHONE.matches) return;
  dragged = { from: clientY, height: panel.getBoundingClientRect().height };
  grip.setPointerCapture(pointerId);
});
grip.addEventListener("pointermove", ({ clientY }) => {
  if (!dragged) return;
  dragged.by = clientY - dragged.from;
  panel.style.transition = "none";
  panel.style.height = `${Math.max(dragged.height - dragged.by, 60)}px`;
});
grip.addEventListener("pointerup", () => {
  const by = dragged?.by ?? 0;
  dragged = undefined;
  panel.style.removeProperty("height");
  panel.style.removeProperty("transition");
  if (Math.abs(by) < 24) return;
  const now = HEIGHTS.indexOf(panel.dataset.detent);
  setDetent(HEIGHTS[Math.min(Math.max(now + (by < 0 ? 1 : -1), 0), 2)]);
  justDragged = true;
  setTimeout(() => (justDragged = false), 0);
});
let justDragged = false;
grip.addEventListener("click", () => {
  if (justDragged) return;
  if (!PHONE.matches) togglePanel();
  else setDetent(HEIGHTS[(HEIGHTS.indexOf(panel.dataset.detent) + 1) % 3]);
});

new ResizeObserver(tellHeight).observe(panel);
new ResizeObserver(tellHeight).observe(document.getElementById("bar"));
setDetent(PHONE.matches ? "peek" : "half");
