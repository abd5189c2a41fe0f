/** What is selected and shown, and the few things that every part of the page needs. */

export const VIEWS = {
  all: { title: "All", panes: ["left", "right", "disparity", "depth", "visible", "anaglyph"] },
  left: { title: "Left", panes: ["left"] },
  right: { title: "Right", panes: ["right"] },
  disparity: { title: "Disparity", panes: ["disparity"] },
  depth: { title: "Depth", panes: ["depth"] },
  visible: { title: "Visible", panes: ["visible"] },
  anaglyph: { title: "Anaglyph", panes: ["anaglyph"] },
  wiggle: { title: "Wiggle", panes: ["wiggle"] },
};
export const NEEDS = {
  left: ["left"], right: ["right"], disparity: ["disparity"], depth: ["depth"],
  visible: ["left", "visible", "disparity"], anaglyph: ["left", "right"], wiggle: ["left", "right"],
};

export const state = {
  about: null, colours: null, scene: null, pair: 0, frame: 0, view: "all", point: null, playing: false,
  scales: {}, material: {}, total: 0, pages: new Map(), choice: "", panes: [],
};

/** The names in a link that say what is shown; all other names are filters. */
export const SHOWN = ["key", "pair", "frame", "view"];

export const $ = (id) => document.getElementById(id);

export const plural = (number, word) => `${number.toLocaleString("en")} ${word}${number === 1 ? "" : "s"}`;

export const isTouched = () => matchMedia("(pointer: coarse)").matches;

/** Text that a narrow page breaks after a slash rather than within a name. */
export function writePath(element, text) {
  element.replaceChildren(...text.split(/(?<=\/)/).flatMap((part) => [part, document.createElement("wbr")]));
}

export function tell(element, text) {
  element.textContent = text || "";
  element.hidden = !text;
}
