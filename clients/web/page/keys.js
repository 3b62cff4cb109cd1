// The keys: what they do, and the page that lists them.

const help = document.getElementById("help");

/** Binds `[{ keys: ["F"], says, act }]`; those without `act` are listed only. */
export function bindKeys(bindings) {
  const list = bindings.filter(({ says }) => says).flatMap(({ keys, says }) => {
    const term = document.createElement("dt");
    term.append(...keys.map((key) => Object.assign(document.createElement("kbd"), { textContent: key })));
    return [term, Object.assign(document.createElement("dd"), { textContent: says })];
  });
  document.getElementById("keys").replaceChildren(...list);
  document.getElementById("help-button").addEventListener("click", toggleHelp);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || isTyping(event.target) || document.querySelector("dialog[open]")) return;
    const bound = bindings.find(({ keys, act }) => act && keys.some((key) => matches(key, event.key)));
    if (!bound) return;
    if (event.key === " " && event.target.closest("button, input, summary")) return;
    event.preventDefault();
    bound.act(event.key);
  });
}

export function toggleHelp() {
  if (help.open) help.close();
  else help.showModal();
}

function matches(key, pressed) {
  const name = { Esc: "Escape", Space: " " }[key] ?? key;
  return name.toLowerCase() === pressed.toLowerCase();
}

function isTyping(target) {
  return target.matches?.('input:not([type="range"], [type="radio"], [type="file"]), textarea');
}
