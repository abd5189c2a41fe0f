/** Which pair, frame and view of the scene; what is shown is read here, one moment at a time. */

import { buildPanes, drawPanes } from "/panes.js";
import { showPoint } from "/pixel.js";
import { ask, read } from "/reading.js";
import { $, NEEDS, VIEWS, state, tell, writePath } from "/state.js";
import { scaleOf } from "/views.js";

const MAPS = ["disparity", "depth", "visible"];

export function showPairs() {
  const widest = Math.max(...state.scene.pairs.map((pair) => pair.baseline_cm));
  $("pairs").replaceChildren(...state.scene.pairs.map((pair, number) => {
    const button = document.createElement("button");
    button.type = "button";
    button.role = "radio";
    button.className = `pair${pair.primary ? " primary" : ""}${pair.chosen ? "" : " off"}`;
    button.ariaChecked = String(number === state.pair);
    button.tabIndex = number === state.pair ? 0 : -1;
    const [left, right] = pair.cameras;
    button.title = `cameras ${left} and ${right}, ${pair.baseline_cm.toFixed(3)} cm, bin ${pair.bin}`
      + (pair.primary ? ", the recorded pair" : "") + (pair.chosen ? "" : ", not selected");
    const name = document.createElement("b");
    name.textContent = `${left}-${right}`;
    const cm = document.createElement("small");
    cm.textContent = `${pair.baseline_cm.toFixed(pair.baseline_cm < 100 ? 1 : 0)} cm`;
    const bar = document.createElement("i");
    bar.style.width = `${(100 * pair.baseline_cm) / widest}%`;
    button.append(name, cm, bar);
    button.addEventListener("click", () => selectPair(number));
    return button;
  }));
  scrollToChosen($("pairs"));
}

/** Where a strip of buttons is too narrow for all, bring the chosen one into sight. */
function scrollToChosen(strip) {
  const chosen = strip.querySelector("[aria-checked=true], [aria-pressed=true]");
  if (!chosen || strip.scrollWidth <= strip.clientWidth) return;
  const { left, width } = chosen.getBoundingClientRect(), box = strip.getBoundingClientRect();
  strip.scrollLeft += left + width / 2 - box.left - box.width / 2;
}

export function selectPair(number) {
  if (!state.scene) return;
  state.pair = Math.min(Math.max(number, 0), state.scene.pairs.length - 1);
  const hadFocus = $("pairs").contains(document.activeElement);
  for (const [place, button] of [...$("pairs").children].entries()) {
    button.ariaChecked = String(place === state.pair);
    button.tabIndex = place === state.pair ? 0 : -1;
    if (hadFocus && place === state.pair) button.focus();
  }
  scrollToChosen($("pairs"));
  refresh();
}

export function selectFrame(number) {
  if (!state.scene) return;
  state.frame = Math.min(Math.max(number, 0), state.scene.frames - 1);
  refresh();
}

export function selectView(name) {
  state.view = name;
  for (const button of $("views").children) {
    button.ariaPressed = String(button.dataset.view === name);
  }
  scrollToChosen($("views"));
  buildPanes();
  if (state.scene) refresh();
}

const moment = () => {
  const [left, right] = state.scene.pairs[state.pair].cameras;
  return `key=${encodeURIComponent(state.scene.key)}&left=${left}&right=${right}&frame=${state.frame}`;
};

let wanted = 0, shown = 0, running = null;

/** Show what is selected now; of requests that come faster than pictures only the last counts. */
export function refresh() {
  wanted++;
  running ??= showLatest().finally(() => { running = null; });
  return running;
}

async function showLatest() {
  while (shown !== wanted) {
    const turn = wanted;
    const what = moment(), scene = state.scene, pair = scene.pairs[state.pair], frame = state.frame;
    $("frame").value = frame;
    $("frame-number").textContent = `${frame} / ${scene.frames - 1}`;
    const names = new Set(VIEWS[state.view].panes.flatMap((pane) => NEEDS[pane]));
    if (!state.playing) MAPS.forEach((name) => names.add(name));
    const found = {}, errors = new Set();
    await Promise.all([...names].map(async (name) => {
      try {
        found[name] = await read(name, what);
      } catch (error) {
        errors.add(error.message);
      }
    }));
    shown = turn;
    if (scene !== state.scene || pair !== state.scene.pairs[state.pair]) continue;
    state.material = { ...found, frame };
    tell($("error"), [...errors].join("\n"));
    fixScales(found, `${scene.key} ${pair.cameras}`);
    drawPanes();
    showPoint();
    await showLine(what, turn);
    remember();
  }
}

async function showLine(what, turn) {
  if (state.playing) return;
  const told = await ask(`/api/line?${what}`).catch(() => null);
  if (told && turn === wanted) writePath($("sample-line"), told.line);
}

/** One scale for all frames of a pair, taken from the first that is seen. */
function fixScales(found, name) {
  if (state.scales.name !== name) state.scales = { name };
  if (found.disparity) state.scales.disparity ??= scaleOf(found.disparity);
  if (found.depth) state.scales.depth ??= scaleOf(found.depth, "log");
  showLegends();
}

function showLegends() {
  const shift = (state.scene.fx_px * state.scene.pairs[state.pair].baseline_cm) / 100;
  const metres = (px) => (px === 0 ? "inf" : Number((shift / px).toPrecision(3)));
  legend("disparity-legend", state.scales.disparity, (tick) => `${tick}\n${metres(tick)}`);
  legend("depth-legend", state.scales.depth, (tick) => String(Number(tick.toPrecision(6))));
}

function legend(id, scale, text) {
  const figure = $(id);
  figure.hidden = !scale;
  if (!scale) return;
  const stops = state.about.colours.stops.map((stop) => `rgb(${stop.join()})`);
  if (scale.kind === "log") stops.reverse();
  figure.querySelector(".strip").style.background = `linear-gradient(to right, ${stops.join()})`;
  figure.querySelector(".ticks").replaceChildren(...scale.ticks(6).map((tick) => {
    const span = document.createElement("span");
    const place = scale.place(tick);
    span.className = place < 0.04 ? "first" : place > 0.96 ? "last" : "";
    span.style.left = `${100 * place}%`;
    span.style.whiteSpace = "pre";
    span.textContent = text(tick);
    return span;
  }));
}

function setPlaying(playing) {
  state.playing = playing;
  $("play").ariaPressed = String(playing);
  $("play").textContent = playing ? "Stop" : "Play";
}

export function stop() {
  if (state.playing) setPlaying(false);
}

export async function play() {
  setPlaying(!state.playing);
  while (state.playing) {
    const start = performance.now();
    state.frame = (state.frame + 1) % state.scene.frames;
    await refresh();
    const rest = 1000 / state.scene.frame_rate_hz - (performance.now() - start);
    await new Promise((done) => { setTimeout(done, Math.max(rest, 0)); });
  }
  refresh();
}

/** Put filters, sample and view into the address, which is a link to them. */
export function remember() {
  const place = new URLSearchParams(state.choice);
  if (place.get("pairs") === "all") place.delete("pairs");
  if (state.scene && state.total) {
    place.set("key", state.scene.key);
    place.set("pair", state.scene.pairs[state.pair].cameras.join("-"));
    place.set("frame", state.frame);
  }
  place.set("view", state.view);
  history.replaceState(null, "", `#${String(place).replaceAll("%2F", "/")}`);
}
