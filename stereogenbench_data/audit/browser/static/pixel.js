/** The pixel that is pointed at: what the maps say of it, and where the right view has it. */

import { $, isTouched, state } from "/state.js";

export function pointAt(event, picture, name) {
  const box = picture.querySelector("canvas").getBoundingClientRect();
  const { width_px: width, height_px: height } = state.scene;
  const x = Math.floor(((event.clientX - box.left) / box.width) * width);
  const y = Math.floor(((event.clientY - box.top) / box.height) * height);
  if (x < 0 || y < 0 || x >= width || y >= height) return;
  if (name === "right") return;
  state.point = [x, y];
  showPoint();
}

export function movePoint(dx, dy) {
  const { width_px: width, height_px: height } = state.scene;
  const [x, y] = state.point ?? [Math.floor(width / 2), Math.floor(height / 2)];
  state.point = [Math.min(Math.max(x + dx, 0), width - 1), Math.min(Math.max(y + dy, 0), height - 1)];
  showPoint();
}

/** What the maps say of the pixel that is pointed at, and where the right view has it. */
export function showPoint() {
  if (!state.point) {
    $("at").textContent = `${isTouched() ? "touch" : "point at"} a picture`;
    for (const id of ["disparity-here", "depth-here", "seen-here"]) $(id).textContent = "-";
    state.panes.forEach(({ mark }) => { mark.hidden = true; });
    return;
  }
  const [x, y] = state.point;
  const at = y * state.scene.width_px + x;
  const { disparity, depth, visible } = state.material;
  const measured = disparity && !Number.isNaN(disparity[at]);
  $("at").textContent = `x ${x}, y ${y}`;
  $("disparity-here").textContent = number(disparity, at, "px");
  $("depth-here").textContent = number(depth, at, "m");
  $("seen-here").textContent = !visible ? "..." : visible[at] ? `visible, x ${(x - disparity[at]).toFixed(1)}`
    : measured ? "hidden or outside" : "not known";
  for (const { name, mark } of state.panes) {
    const there = name === "right" ? (measured ? x - disparity[at] : NaN) : x;
    mark.hidden = !(there >= -0.5 && there < state.scene.width_px);
    mark.style.left = `${(100 * (there + 0.5)) / state.scene.width_px}%`;
    mark.style.top = `${(100 * (y + 0.5)) / state.scene.height_px}%`;
  }
}

function number(values, at, unit) {
  if (!values) return "...";
  return Number.isNaN(values[at]) ? "not measured" : `${values[at].toFixed(3)} ${unit}`;
}
