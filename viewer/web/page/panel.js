// The panel: words, switches and the list of cameras. What strangers named is set as text, never as markup.

export const SWITCHES = [
  ["gaussians", "Gaussians", "1", true],
  ["points", "as points", "g", false],
  ["cameras", "cameras", "2", true],
  ["photographs", "photographs", "3", true],
  ["path", "path", "4", true],
  ["tracked", "tracked camera", "5", true],
  ["advice", "next view", "6", true],
  ["uncertainty", "uncertainty", "7", true],
  ["graph", "graph of a map", "8", true],
  ["ground", "ground grid", "9", true],
  ["given", "given poses", "0", true],
];

const byId = (id) => document.getElementById(id);

function element(tag, text, parent) {
  const made = document.createElement(tag);
  made.textContent = text;
  parent.append(made);
  return made;
}

/** Sets the children of `parent` only where `key` is another than before: a list keeps where it is scrolled to. */
function refill(parent, key, fill) {
  if (parent.dataset.key === key) return;
  parent.dataset.key = key;
  parent.replaceChildren();
  fill(parent);
}

export class Panel {
  /** `pressed(key)` for a key or button, `chosen(name)` for a camera of the list, `blended()` for the slider. */
  constructor(pressed, chosen, blended) {
    this.shown = Object.fromEntries(SWITCHES.map(([name, , , on]) => [name, on]));
    this.boxes = {};
    this.labels = {};
    for (const [name, text, key] of SWITCHES) {
      const label = element("label", "", byId("switches"));
      const box = element("input", "", label);
      box.type = "checkbox";
      box.checked = this.shown[name];
      box.addEventListener("change", () => pressed(key));
      label.append(text);
      label.title = `(${key})`;
      this.boxes[name] = box;
      this.labels[name] = label;
    }
    for (const button of document.querySelectorAll("button[data-key]"))
      button.addEventListener("click", () => pressed(button.dataset.key));
    this.cameras = byId("cameras");
    this.cameras.addEventListener("change", () => chosen(this.cameras.value || null));
    this.slider = document.querySelector("#blend input");
    this.slider.addEventListener("input", blended);
    for (const control of document.querySelectorAll("#panel input, #panel select, #panel button"))
      control.addEventListener("change", () => control.blur()); // keys are for the picture again
  }

  /** Switches what `key` stands for; whether there is such a thing. */
  toggle(key) {
    const found = SWITCHES.find((one) => one[2] === key);
    if (!found) return false;
    const [name] = found;
    this.boxes[name].checked = this.shown[name] = !this.shown[name];
    return true;
  }

  /** Whether the switch `name` is there: of what there is nothing of, there is none. */
  offer(name, there) {
    this.labels[name].hidden = !there;
  }

  say({ good, state, verdict = [], sections = [] }) {
    byId("state").textContent = state ?? "";
    byId("verdict").className = good === null ? "" : good ? "good" : "bad";
    const paragraphs = (lines) => (parent) => lines.forEach((line) => element("p", line, parent));
    refill(byId("verdict"), JSON.stringify(verdict), paragraphs(verdict));
    refill(byId("sections"), JSON.stringify(sections), (parent) => {
      for (const [heading, lines] of sections) {
        element("h2", heading, parent);
        const list = element("ul", "", parent);
        for (const line of lines) element("li", line, list);
      }
    });
  }

  list(names) {
    refill(this.cameras, JSON.stringify(names), (parent) => {
      element("option", "free view", parent).value = "";
      for (const name of names) element("option", name, parent).value = name;
    });
  }

  choose(name) {
    if (this.cameras.value !== (name ?? "")) this.cameras.value = name ?? "";
    byId("blend").hidden = name === null;
  }

  set rate(text) {
    byId("rate").textContent = text;
  }

  set notice(text) {
    byId("notice").textContent = text;
  }

  get blend() {
    return Number(this.slider.value);
  }
}
