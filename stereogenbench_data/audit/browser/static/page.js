import { paintAnaglyph, paintMap, paintVisible, palette, scaleOf } from "/views.js";

const $ = (id) => document.getElementById(id);
const ROW_PX = 46;
const PAGE_ROWS = 100;
const KEPT_BYTES = 192 * 2 ** 20;
const FACETS = ["split", "subset", "family", "map", "bin"];
const VIEWS = {
  all: { title: "All", panes: ["left", "right", "disparity", "depth", "visible", "anaglyph"] },
  left: { title: "Left", panes: ["left"] },
  right: { title: "Right", panes: ["right"] },
  disparity: { title: "Disparity", panes: ["disparity"] },
  depth: { title: "Depth", panes: ["depth"] },
  visible: { title: "Visible", panes: ["visible"] },
  anaglyph: { title: "Anaglyph", panes: ["anaglyph"] },
  wiggle: { title: "Wiggle", panes: ["wiggle"] },
};
const NEEDS = {
  left: ["left"], right: ["right"], disparity: ["disparity"], depth: ["depth"],
  visible: ["left", "visible", "disparity"], anaglyph: ["left", "right"], wiggle: ["left", "right"],
};
const MAPS = ["disparity", "depth", "visible"];
const FILES = {
  left: "/left.jpg", right: "/right.jpg", disparity: "/disparity.f32", depth: "/depth.f32",
  visible: "/visible.u8",
};

const state = {
  about: null, colours: null, scene: null, pair: 0, frame: 0, view: "all", point: null, playing: false,
  scales: {}, material: {}, total: 0, pages: new Map(), choice: "",
};

// ---- asking the server

class Refused extends Error {}

async function ask(url, kind = "json") {
  let answer;
  try {
    answer = await fetch(url);
  } catch {
    throw new Refused("The command no longer answers: is `stereogenbench browse` still running?");
  }
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({ error: `answer ${answer.status}` }));
    throw new Refused(told.error);
  }
  if (kind === "json") return answer.json();
  return kind === "blob" ? answer.blob() : answer.arrayBuffer();
}

const kept = new Map();
let keptBytes = 0;

/** One picture or map of a moment; the last ones are kept, up to a number of bytes. */
function read(name, moment) {
  const url = `${FILES[name]}?${moment}&v=${state.about.started}`;
  if (kept.has(url)) {
    const found = kept.get(url);
    kept.delete(url);
    kept.set(url, found);
    return found.promise;
  }
  const { width_px: width, height_px: height } = state.scene;
  const bytes = width * height * 4;
  const promise = (name === "left" || name === "right" ? readPicture(url, width, height)
    : readMap(url, name)).catch((error) => {
    drop(url);
    throw error;
  });
  kept.set(url, { promise, bytes });
  keptBytes += bytes;
  for (const oldest of kept.keys()) {
    if (keptBytes <= KEPT_BYTES || oldest === url) break;
    drop(oldest);
  }
  return promise;
}

function drop(url) {
  if (!kept.has(url)) return;
  keptBytes -= kept.get(url).bytes;
  kept.delete(url);
}

async function readPicture(url, width, height) {
  const bitmap = await createImageBitmap(await ask(url, "blob"));
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0, width, height);
  bitmap.close();
  return context.getImageData(0, 0, width, height);
}

async function readMap(url, name) {
  const buffer = await ask(url, "buffer");
  return name === "visible" ? new Uint8Array(buffer) : new Float32Array(buffer);
}

// ---- choosing scenes

function choiceQuery() {
  const query = new URLSearchParams();
  for (const name of FACETS) {
    for (const box of $(`facet-${name}`).querySelectorAll("input:checked")) {
      query.append(name, box.value);
    }
  }
  for (const name of ["focal", "baseline"]) {
    const low = $(`${name}-low`).value, high = $(`${name}-high`).value;
    if (low === "" && high === "") continue;
    const [least, most] = state.about[`${name}_${name === "focal" ? "mm" : "cm"}`];
    query.set(`${name}_low`, low === "" ? Math.min(Math.floor(least), Number(high)) : low);
    query.set(`${name}_high`, high === "" ? Math.max(Math.ceil(most), Number(low)) : high);
  }
  if ($("caption").value.trim()) query.set("caption", $("caption").value.trim());
  query.set("pairs", $("pair-kind").value);
  return query.toString();
}

let choosing = 0;

/** Counts, list and lines for what the form says. */
async function choose() {
  const turn = ++choosing;
  state.choice = choiceQuery();
  try {
    const found = await ask(`/api/choice?${state.choice}`);
    if (turn !== choosing) return;
    showCounts(found.counts);
    state.total = found.scenes;
    state.pages.clear();
    $("count").textContent = `${plural(found.scenes, "scene")}, ${plural(found.pairs, "pair")}`;
    tell($("reason"), found.reason);
    $("selection-line").textContent = found.scenes ? found.line : "";
    $("copy-selection").disabled = !found.scenes;
    $("rows").style.height = `${found.scenes * ROW_PX}px`;
    $("list").scrollTop = 0;
    await showRows();
    if (state.scene) await selectScene(state.scene.key, { keep: true });
    if (found.scenes && !(state.scene?.place >= 0)) await selectPlace(0);
  } catch (error) {
    if (turn === choosing) tell($("reason"), error.message);
  }
}

const plural = (number, word) => `${number.toLocaleString("en")} ${word}${number === 1 ? "" : "s"}`;

function tell(element, text) {
  element.textContent = text || "";
  element.hidden = !text;
}

function showCounts(counts) {
  for (const name of FACETS) {
    const box = $(`facet-${name}`);
    if (!box.childElementCount) {
      for (const value of Object.keys(counts[name])) box.append(facetRow(name, value));
      box.parentElement.hidden = !Object.keys(counts[name]).length;
    }
    for (const row of box.children) {
      const count = counts[name][row.dataset.value] ?? 0;
      row.querySelector("b").textContent = count.toLocaleString("en");
      row.classList.toggle("none", count === 0);
    }
  }
}

function facetRow(name, value) {
  const row = document.createElement("label");
  row.dataset.value = value;
  const box = document.createElement("input");
  Object.assign(box, { type: "checkbox", name, value });
  const text = document.createElement("span");
  text.textContent = value;
  text.title = value;
  row.append(box, text, document.createElement("b"));
  return row;
}

/** The rows of one page of the list, asked for once. */
function page(number) {
  if (!state.pages.has(number)) {
    const url = `/api/scenes?${state.choice}&first=${number * PAGE_ROWS}&count=${PAGE_ROWS}`;
    const rows = ask(url).then((found) => found.rows);
    rows.catch(() => state.pages.delete(number));
    state.pages.set(number, rows);
  }
  return state.pages.get(number);
}

let drawingRows = 0;

/** The rows that are in sight, and a few beyond. */
async function showRows() {
  const turn = ++drawingRows;
  const list = $("list");
  const first = Math.max(0, Math.floor(list.scrollTop / ROW_PX) - 8);
  const last = Math.min(state.total, Math.ceil((list.scrollTop + list.clientHeight) / ROW_PX) + 8);
  const rows = [];
  for (let number = first; number < last;) {
    const found = await page(Math.floor(number / PAGE_ROWS));
    if (turn !== drawingRows) return;
    const start = number % PAGE_ROWS;
    const part = found.slice(start, start + last - number);
    if (!part.length) break;
    rows.push(...part.map((row, i) => listRow(row, number + i)));
    number += part.length;
  }
  if (turn === drawingRows) $("rows").replaceChildren(...rows);
}

function listRow(row, place) {
  const element = document.createElement("div");
  const [split, ...parts] = row.key.split("/");
  const [family, map, name] = parts.slice(-3);
  const range = row.baseline_cm.map((cm) => cm.toFixed(cm < 100 ? 1 : 0)).join(" to ");
  element.className = "row";
  element.id = `row-${place}`;
  element.role = "option";
  element.ariaSelected = String(row.key === state.scene?.key);
  element.style.top = `${place * ROW_PX}px`;
  element.title = row.key;
  const title = document.createElement("b");
  title.textContent = `${name} `;
  const facts = document.createElement("small");
  const part = [split, row.subset.replace("_map", "")].filter(Boolean).join(" ");
  facts.textContent = `${part}, ${family}, ${range} cm`;
  element.append(title, map, facts);
  element.addEventListener("click", () => selectScene(row.key));
  return element;
}

async function selectPlace(place) {
  if (place < 0 || place >= state.total) return;
  const rows = await page(Math.floor(place / PAGE_ROWS));
  await selectScene(rows[place % PAGE_ROWS].key);
}

async function selectScene(key, { keep = false, pair = null, frame = 0 } = {}) {
  let scene;
  try {
    scene = await ask(`/api/scene?key=${encodeURIComponent(key)}&${state.choice}`);
  } catch (error) {
    return tell($("error"), error.message);
  }
  const cameras = keep && state.scene ? state.scene.pairs[state.pair].cameras : pair;
  state.scene = scene;
  if (!keep) state.frame = Math.min(frame, scene.frames - 1);
  const asked = scene.pairs.findIndex((each) => String(each.cameras) === String(cameras));
  const primary = scene.pairs.findIndex((each) => each.primary);
  const chosen = scene.pairs.findIndex((each) => each.chosen);
  const fits = asked >= 0 && (!keep || chosen < 0 || scene.pairs[asked].chosen);
  state.pair = fits ? asked : primary >= 0 && (scene.pairs[primary].chosen || chosen < 0)
    ? primary : Math.max(chosen, 0);
  if (!keep) state.point = null;
  $("key").textContent = scene.key;
  $("scene-caption").textContent = scene.caption;
  $("facts").textContent = [
    `${scene.width_px} x ${scene.height_px} px`,
    `${scene.frames} frames at ${scene.frame_rate_hz} Hz`,
    `focal length ${Number(scene.focal_mm.toFixed(2))} mm, fx ${scene.fx_px.toFixed(1)} px`,
    `depth unit ${scene.depth_unit_m ?? "?"} m (${scene.depth_unit_source})`,
    ...(scene.rig_residual_px > 0.05 ? [`not rectified, by ${scene.rig_residual_px.toPrecision(2)} px`] : []),
  ].join("; ");
  $("frame").max = scene.frames - 1;
  showPairs();
  keepInSight(scene.place);
  await showRows();
  refresh();
}

function keepInSight(place) {
  const list = $("list");
  list.setAttribute("aria-activedescendant", place < 0 ? "" : `row-${place}`);
  if (place < 0) return;
  const top = place * ROW_PX;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + ROW_PX > list.scrollTop + list.clientHeight) {
    list.scrollTop = top + ROW_PX - list.clientHeight;
  }
}

// ---- pairs, frames, views

function showPairs() {
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
}

function selectPair(number) {
  if (!state.scene) return;
  state.pair = Math.min(Math.max(number, 0), state.scene.pairs.length - 1);
  const hadFocus = $("pairs").contains(document.activeElement);
  for (const [place, button] of [...$("pairs").children].entries()) {
    button.ariaChecked = String(place === state.pair);
    button.tabIndex = place === state.pair ? 0 : -1;
    if (hadFocus && place === state.pair) button.focus();
  }
  refresh();
}

function selectFrame(number) {
  if (!state.scene) return;
  state.frame = Math.min(Math.max(number, 0), state.scene.frames - 1);
  refresh();
}

function selectView(name) {
  state.view = name;
  for (const button of $("views").children) {
    button.ariaPressed = String(button.dataset.view === name);
  }
  buildPanes();
  refresh();
}

const moment = () => {
  const [left, right] = state.scene.pairs[state.pair].cameras;
  return `key=${encodeURIComponent(state.scene.key)}&left=${left}&right=${right}&frame=${state.frame}`;
};

let wanted = 0, shown = 0, running = null;

/** Show what is selected now; of requests that come faster than pictures only the last counts. */
function refresh() {
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
  if (told && turn === wanted) $("sample-line").textContent = told.line;
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

// ---- drawing

let panes = [];

function buildPanes() {
  panes = VIEWS[state.view].panes.map((name) => {
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
  $("stage").replaceChildren(...panes.map((pane) => pane.figure));
}

/** Make the pictures as large as the window allows, all of one size. */
function fitPanes() {
  if (!state.scene || !panes.length) return;
  const { width_px: width, height_px: height } = state.scene;
  const stage = $("stage"), gap = 10, caption = 22;
  const beside = matchMedia("(min-width: 1101px)").matches;
  const inside = $("stage").parentElement.clientWidth - (beside ? 20 + 290 : 0);
  const top = stage.getBoundingClientRect().top + document.querySelector("main").scrollTop;
  const room = Math.max(beside ? 320 : 420, window.innerHeight - top - 18);
  const columns = panes.length > 1 ? (inside > 620 ? 3 : 2) : 1;
  const lines = Math.ceil(panes.length / columns);
  const widest = (inside - gap * (columns - 1)) / columns - 2;
  const tallest = (room - gap * (lines - 1)) / lines - caption - 2;
  let scale = Math.min(widest / width, tallest / height);
  if (scale > 1) scale = Math.max(1, Math.floor(scale * 4) / 4);
  stage.style.gridTemplateColumns = `repeat(${columns}, max-content)`;
  for (const { picture } of panes) {
    picture.style.width = `${Math.floor(width * scale) + 2}px`;
    picture.style.height = `${Math.floor(height * scale) + 2}px`;
    picture.classList.toggle("sharp", scale > 1.5);
  }
}

const wiggle = { side: "left", timer: 0 };

function drawPanes() {
  fitPanes();
  for (const pane of panes) {
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
  const pane = panes.find(({ name }) => name === "wiggle");
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

// ---- the pixel under the cursor

function pointAt(event, picture, name) {
  const box = picture.querySelector("canvas").getBoundingClientRect();
  const { width_px: width, height_px: height } = state.scene;
  const x = Math.floor(((event.clientX - box.left) / box.width) * width);
  const y = Math.floor(((event.clientY - box.top) / box.height) * height);
  if (x < 0 || y < 0 || x >= width || y >= height) return;
  if (name === "right") return;
  state.point = [x, y];
  showPoint();
}

function movePoint(dx, dy) {
  const { width_px: width, height_px: height } = state.scene;
  const [x, y] = state.point ?? [Math.floor(width / 2), Math.floor(height / 2)];
  state.point = [Math.min(Math.max(x + dx, 0), width - 1), Math.min(Math.max(y + dy, 0), height - 1)];
  showPoint();
}

/** What the maps say of the pixel that is pointed at, and where the right view has it. */
function showPoint() {
  if (!state.point) {
    $("at").textContent = "point at a picture";
    for (const id of ["disparity-here", "depth-here", "seen-here"]) $(id).textContent = "-";
    panes.forEach(({ mark }) => { mark.hidden = true; });
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
  for (const { name, mark } of panes) {
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

// ---- playing, copying, remembering

async function play() {
  state.playing = !state.playing;
  $("play").ariaPressed = String(state.playing);
  $("play").textContent = state.playing ? "Stop" : "Play";
  while (state.playing) {
    const start = performance.now();
    state.frame = (state.frame + 1) % state.scene.frames;
    await refresh();
    const rest = 1000 / state.scene.frame_rate_hz - (performance.now() - start);
    await new Promise((done) => { setTimeout(done, Math.max(rest, 0)); });
  }
  refresh();
}

async function copy(id, button) {
  const before = [...button.childNodes];
  try {
    await navigator.clipboard.writeText($(id).textContent);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren($(id));
    button.textContent = "Selected: press Ctrl+C";
  }
  setTimeout(() => button.replaceChildren(...before), 1200);
}

function remember() {
  const place = new URLSearchParams({
    key: state.scene.key, pair: state.scene.pairs[state.pair].cameras.join("-"),
    frame: state.frame, view: state.view,
  });
  history.replaceState(null, "", `#${place}`);
}

// ---- keys

const KEYS = {
  ArrowLeft: (event) => selectFrame(state.frame - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => selectFrame(state.frame + (event.shiftKey ? 10 : 1)),
  ArrowUp: () => selectPair(state.pair - 1),
  ArrowDown: () => selectPair(state.pair + 1),
  Home: () => selectFrame(0),
  End: () => selectFrame(Infinity),
  j: () => selectPlace(state.scene.place + 1),
  k: () => selectPlace(state.scene.place - 1),
  w: (event) => movePoint(0, event.shiftKey ? -10 : -1),
  a: (event) => movePoint(event.shiftKey ? -10 : -1, 0),
  s: (event) => movePoint(0, event.shiftKey ? 10 : 1),
  d: (event) => movePoint(event.shiftKey ? 10 : 1, 0),
  c: () => copy("sample-line", $("copy-sample")),
  "/": () => $("caption").focus(),
  "?": () => $("help").showModal(),
  " ": () => play(),
};
const LIST_KEYS = {
  ArrowUp: () => selectPlace(state.scene.place - 1),
  ArrowDown: () => selectPlace(state.scene.place + 1),
  Home: () => selectPlace(0),
  End: () => selectPlace(state.total - 1),
  PageUp: () => selectPlace(Math.max(state.scene.place - 10, 0)),
  PageDown: () => selectPlace(Math.min(state.scene.place + 10, state.total - 1)),
};

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const at = event.target;
  const types = at.matches("select, textarea, input:not([type=range], [type=checkbox])");
  if (types || !state.scene) return;
  if (event.key === " " && at.matches("button, summary, input[type=checkbox]")) return;
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const views = Object.keys(VIEWS);
  const act = (at.id === "list" && LIST_KEYS[name]) || KEYS[name]
    || (name >= "1" && name <= String(views.length) && (() => selectView(views[name - 1])));
  if (!act) return;
  event.preventDefault();
  act(event);
}

// ---- start

function listen() {
  let waiting = 0;
  $("filters").addEventListener("input", () => {
    clearTimeout(waiting);
    waiting = setTimeout(choose, 150);
  });
  $("filters").addEventListener("change", (event) => {
    if (event.target.name === "bin") ["low", "high"].forEach((end) => { $(`baseline-${end}`).value = ""; });
    if (event.target.id.startsWith("baseline-")) {
      $("facet-bin").querySelectorAll("input:checked").forEach((box) => { box.checked = false; });
    }
  });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("reset").addEventListener("click", () => {
    $("filters").reset();
    choose();
  });
  $("list").addEventListener("scroll", () => showRows());
  $("frame").addEventListener("input", () => selectFrame(Number($("frame").value)));
  $("play").addEventListener("click", play);
  $("copy-sample").addEventListener("click", () => copy("sample-line", $("copy-sample")));
  $("copy-selection").addEventListener("click", () => copy("selection-line", $("copy-selection")));
  $("help-button").addEventListener("click", () => $("help").showModal());
  $("left-out").addEventListener("click", () => $("left-out-list").showModal());
  document.addEventListener("keydown", pressed);
  window.addEventListener("unhandledrejection", (event) => tell($("error"), event.reason.message));
  window.addEventListener("resize", () => { fitPanes(); showRows(); });
}

function showAbout() {
  const { about } = state;
  state.colours = palette(about.colours.stops);
  $("data").textContent = about.data;
  document.title = `${about.data.split("/").filter(Boolean).pop() ?? ""} - StereoGenBench scenes`;
  tell($("contract"), about.depth);
  const left = Object.entries(about.left_out);
  tell($("left-out"), left.length ? `${plural(left.length, "scene")} left out` : "");
  $("left-out-list").querySelector("ul").replaceChildren(...left.map(([key, reason]) => {
    const item = document.createElement("li");
    item.textContent = reason.includes(key) ? reason : `${key}: ${reason}`;
    return item;
  }));
  $("swatch-hidden").style.background = `rgb(${about.colours.hidden.join()})`;
  $("swatch-grey").style.background = `rgb(${about.colours.not_measured.join()})`;
  for (const [name, unit] of [["focal", "mm"], ["baseline", "cm"]]) {
    const [least, most] = about[`${name}_${unit}`];
    $(`${name}-low`).placeholder = Number(least.toFixed(1));
    $(`${name}-high`).placeholder = Number(most.toFixed(1));
  }
  for (const [place, [name, view]] of Object.entries(VIEWS).entries()) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", title: `${view.title} (key ${place + 1})` });
    button.dataset.view = name;
    button.ariaPressed = String(name === state.view);
    button.textContent = view.title;
    button.addEventListener("click", () => selectView(name));
    $("views").append(button);
  }
}

async function start() {
  state.about = await ask("/api/about");
  const place = new URLSearchParams(location.hash.slice(1));
  if (place.get("view") in VIEWS) state.view = place.get("view");
  showAbout();
  buildPanes();
  listen();
  state.choice = choiceQuery();
  if (place.has("key")) {
    const pair = (place.get("pair") ?? "").split("-").map(Number);
    await selectScene(place.get("key"), { pair, frame: Number(place.get("frame")) || 0 });
  }
  await choose();
  document.body.dataset.ready = "yes";
}

start().catch((error) => tell($("error"), error.message));
