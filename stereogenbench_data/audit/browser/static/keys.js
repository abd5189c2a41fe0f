/** What each key does. */

import { selectPlace, step } from "/choosing.js";
import { copy } from "/copying.js";
import { openDrawer } from "/drawer.js";
import { play, selectFrame, selectPair, selectView } from "/moment.js";
import { movePoint } from "/pixel.js";
import { $, VIEWS, state } from "/state.js";

const KEYS = {
  ArrowLeft: (event) => selectFrame(state.frame - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => selectFrame(state.frame + (event.shiftKey ? 10 : 1)),
  ArrowUp: () => selectPair(state.pair - 1),
  ArrowDown: () => selectPair(state.pair + 1),
  Home: () => selectFrame(0),
  End: () => selectFrame(Infinity),
  j: () => step(1),
  k: () => step(-1),
  w: (event) => movePoint(0, event.shiftKey ? -10 : -1),
  a: (event) => movePoint(event.shiftKey ? -10 : -1, 0),
  s: (event) => movePoint(0, event.shiftKey ? 10 : 1),
  d: (event) => movePoint(event.shiftKey ? 10 : 1, 0),
  c: () => copy("sample-line", $("copy-sample")),
  "/": () => openDrawer($("caption")),
  "?": () => $("help").showModal(),
  " ": () => play(),
};
const LIST_KEYS = {
  ArrowUp: () => step(-1),
  ArrowDown: () => step(1),
  Home: () => selectPlace(0),
  End: () => selectPlace(state.total - 1),
  PageUp: () => step(-10),
  PageDown: () => step(10),
};

export function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const at = event.target;
  const types = at.matches("select, textarea, input:not([type=range], [type=checkbox])");
  if (types || !state.scene) return;
  if (document.body.classList.contains("nothing") && event.key !== "/" && event.key !== "?") return;
  if (event.key === " " && at.matches("button, summary, input[type=checkbox]")) return;
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const views = Object.keys(VIEWS);
  const act = (at.id === "list" && LIST_KEYS[name]) || KEYS[name]
    || (name >= "1" && name <= String(views.length) && (() => selectView(views[name - 1])));
  if (!act) return;
  event.preventDefault();
  act(event);
}
