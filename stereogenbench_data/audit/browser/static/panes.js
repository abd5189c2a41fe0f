/** Draws the pictures of a view, all of one size. */

import { pointAt } from "/pixel.js";
import { $, NEEDS, VIEWS, state } from "/state.js";
import { paintAnaglyph, paintMap, paintVisible } from "/views.js";

export function buildPanes() {
  state.panes = VIEWS[state.view].panes.map((name) => {
    const figure = document.createElement("figure");
    figure.className = `pane of-${name === "right" ? "right" : "left"}`;
    const caption = document.createElement("figcaption");
    const picture = document.createElement("div");
    picture.className = "picture";
    picture.dataset.pane = name;
    const canvas = document.createElement("canvas");
    canvas.role = "img";
    canvas.ariaLabel = VIEWS[name].title;
    const mark = document.createElement("div");
    mark.className = "mark";
    mark.hidden = true;
    picture.append(canvas, mark);
    figure.append(caption, picture);
    picture.addEventListener("pointermove", (event) => pointAt(event, picture, name));
    picture.addEventListener("pointerdown", (event) => pointAt(event, picture, name));
    return { name, figure, caption, picture, canvas, mark };
  });
  $("stage").replaceChildren(...state.panes.map((pane) => pane.figure));
}

/** Make the pictures as large as the window allows, all of one size. */
export function fitPanes() {
  if (!state.scene || !state.panes.length) return;
  const { width_px: width, height_px: height } = state.scene;
  const stage = $("stage"), gap = 10, caption = 22;
  const beside = matchMedia("(min-width: 1101px)").matches;
  const main = document.querySelector("main"), { paddingLeft, paddingRight } = getComputedStyle(main);
  const inside = main.clientWidth - parseFloat(paddingLeft) - parseFloat(paddingRight)
    - (beside ? 20 + 290 : 0);
  const top = stage.getBoundingClientRect().top + main.scrollTop + scrollY;
  const room = Math.max(beside ? 320 : 420, window.innerHeight - top - 18);
  const columns = state.panes.length > 1 ? (inside > 480 ? 3 : 2) : 1;
  const lines = Math.ceil(state.panes.length / columns);
  const widest = (inside - gap * (columns - 1)) / columns - 2;
  const tallest = (room - gap * (lines - 1)) / lines - caption - 2;
  let scale = Math.min(widest / width, tallest / height);
  if (scale > 1) scale = Math.max(1, Math.floor(scale * 4) / 4);
  stage.style.gridTemplateColumns = `repeat(${columns}, max-content)`;
  for (const { picture } of state.panes) {
    picture.style.width = `${Math.floor(width * scale) + 2}px`;
    picture.style.height = `${Math.floor(height * scale) + 2}px`;
    picture.classList.toggle("sharp", scale > 1.5);
  }
}

const wiggle = { side: "left", timer: 0 };

export function drawPanes() {
  fitPanes();
  for (const pane of state.panes) {
    const { width_px: width, height_px: height } = state.scene;
    Object.assign(pane.canvas, { width, height });
    const image = paneImage(pane.name, width, height);
    pane.picture.classList.toggle("empty", !image);
    if (image) pane.canvas.getContext("2d").putImageData(image, 0, 0);
    pane.caption.replaceChildren(...paneCaption(pane.name));
  }
  clearInterval(wiggle.timer);
  if (state.view === "wiggle") {
    const slow = matchMedia("(prefers-reduced-motion: reduce)").matches;
    wiggle.timer = setInterval(flipWiggle, slow ? 1200 : 250);
  }
}

function flipWiggle() {
  const pane = state.panes.find(({ name }) => name === "wiggle");
  if (!pane || !state.material.left || !state.material.right) return;
  wiggle.side = wiggle.side === "left" ? "right" : "left";
  pane.canvas.getContext("2d").putImageData(state.material[wiggle.side], 0, 0);
  pane.caption.replaceChildren(...paneCaption("wiggle"));
}

function paneImage(name, width, height) {
  const found = state.material;
  if (!NEEDS[name].every((each) => found[each])) return null;
  const { not_measured: grey, hidden } = state.about.colours;
  const fresh = () => new ImageData(width, height);
  if (name === "left" || name === "right") return found[name];
  if (name === "wiggle") return found[wiggle.side];
  if (name === "anaglyph") return paintAnaglyph(found.left, found.right, fresh());
  if (name === "visible") {
    return paintVisible(found.left, found.visible, found.disparity, { hidden, grey }, fresh());
  }
  return paintMap(found[name], state.scales[name], state.colours, grey, fresh());
}

function paneCaption(name) {
  const [left, right] = state.scene.pairs[state.pair].cameras;
  const bold = document.createElement("b");
  if (name === "left" || name === "right") {
    bold.textContent = name;
    return [bold, `, camera ${name === "left" ? left : right}`];
  }
  if (name === "wiggle") return [`${wiggle.side}, camera ${wiggle.side === "left" ? left : right}`];
  if (name === "visible" && state.material.visible) {
    const seen = state.material.visible.reduce((sum, one) => sum + one, 0);
    return [`visible in both, ${((100 * seen) / state.material.visible.length).toFixed(1)} %`];
  }
  return [VIEWS[name].title.toLowerCase()];
}
