/** Which scenes: the form, the counts, the list, and the one that is selected. */

import { closeDrawer, showDrawerButton } from "/drawer.js";
import { refresh, remember, showPairs, stop } from "/moment.js";
import { ask } from "/reading.js";
import { $, plural, state, tell, writePath } from "/state.js";

const ROW_PX = 46;
const PAGE_ROWS = 100;
const LONG = 8;
const FACETS = ["split", "subset", "family", "map", "bin"];

export function choiceQuery() {
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

/** Set the form to a query of filters, as `choiceQuery` gives it. */
function fillForm(query) {
  const filters = new URLSearchParams(query);
  $("filters").reset();
  for (const name of FACETS) {
    for (const box of $(`facet-${name}`).querySelectorAll("input")) {
      box.checked = filters.getAll(name).includes(box.value);
      if (box.checked) box.closest("details").open = true;
    }
  }
  for (const name of ["focal", "baseline"]) {
    for (const end of ["low", "high"]) $(`${name}-${end}`).value = filters.get(`${name}_${end}`) ?? "";
    if (filters.has(`${name}_low`)) $(`${name}-low`).closest("details").open = true;
  }
  $("caption").value = filters.get("caption") ?? "";
  $("pair-kind").value = filters.get("pairs") ?? "all";
}

let choosing = 0;
let chosen = Promise.resolve();

/** Counts, list and lines for what the form says, or for the filters of a link. */
export function choose(linked = null) {
  chosen = showChoice(linked);
  return chosen;
}

async function showChoice(linked) {
  const turn = ++choosing;
  state.choice = linked ?? choiceQuery();
  try {
    const found = await ask(`/api/choice?${state.choice}`);
    if (turn !== choosing) return;
    showCounts(found.counts);
    if (linked !== null) fillForm(linked);
    state.total = found.scenes;
    state.pages.clear();
    $("count").textContent = `${plural(found.scenes, "scene")}, ${plural(found.pairs, "pair")}`;
    tell($("reason"), found.reason);
    showNothing(found);
    $("selection-line").textContent = found.scenes ? found.line : "";
    $("copy-selection").disabled = !found.scenes;
    $("rows").style.height = `${found.scenes * ROW_PX}px`;
    $("list").scrollTop = 0;
    await showRows();
    if (wanted) await selectScene(wanted, { keep: true });
    if (found.scenes && !(state.scene?.place >= 0)) await selectPlace(0);
    remember();
  } catch (error) {
    if (turn === choosing) showRefused(error.message);
  }
}

/** Show why no scene is left in place of pictures that no filter selects. */
function showNothing({ scenes, reason }) {
  const isNothing = scenes === 0;
  if (isNothing) stop();
  document.body.classList.toggle("nothing", isNothing);
  $("nothing").hidden = !isNothing;
  $("nothing-reason").textContent = reason;
  const filters = new URLSearchParams(state.choice);
  filters.delete("pairs");
  showDrawerButton(scenes, new Set([...filters.keys()].map((name) => name.split("_")[0])).size);
}

/** Show that the filters of a link cannot be understood. */
function showRefused(message) {
  tell($("reason"), message);
  $("count").textContent = "";
  $("rows").replaceChildren();
  state.total = 0;
  showNothing({ scenes: 0, reason: message });
}

function showCounts(counts) {
  for (const name of FACETS) {
    const box = $(`facet-${name}`);
    if (!box.childElementCount) {
      for (const value of Object.keys(counts[name])) box.append(facetRow(name, value));
      box.parentElement.hidden = !Object.keys(counts[name]).length;
      box.classList.toggle("long", box.childElementCount > LONG);
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
export async function showRows() {
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
  element.addEventListener("click", () => {
    selectScene(row.key);
    closeDrawer();
  });
  return element;
}

let stepping = Promise.resolve();

/** Select the scene so many places on. Each step goes from where the last one, or a new choice, led. */
export function step(places) {
  stepping = stepping.then(() => chosen).then(() => {
    const from = state.scene.place;
    const place = Math.min(Math.max(from + places, 0), state.total - 1);
    return place === from ? null : selectPlace(place);
  }).catch((error) => tell($("error"), error.message));
}

export async function selectPlace(place) {
  if (place < 0 || place >= state.total) return;
  const rows = await page(Math.floor(place / PAGE_ROWS));
  await selectScene(rows[place % PAGE_ROWS].key);
}

let selecting = 0;
let wanted = null;

/** Show a scene; return false if it is refused. A later call takes the place of one that waits. */
export async function selectScene(key, { keep = false, pair = null, frame = 0 } = {}) {
  const turn = ++selecting;
  wanted = key;
  let scene;
  try {
    scene = await ask(`/api/scene?key=${encodeURIComponent(key)}&${state.choice}`);
  } catch (error) {
    if (turn === selecting) wanted = state.scene?.key;
    tell($("error"), error.message);
    return false;
  }
  if (turn !== selecting) return true;
  if (!keep) tell($("notice"), "");
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
  writePath($("key"), scene.key);
  $("scene-caption").textContent = scene.caption;
  $("facts").textContent = [
    `${scene.width_px} x ${scene.height_px} px`,
    `${scene.frames} frames at ${scene.frame_rate_hz} Hz`,
    `focal length ${Number(scene.focal_mm.toFixed(2))} mm, fx ${scene.fx_px.toFixed(1)} px`,
    `depth unit ${scene.depth_unit_m ?? "?"} m (${scene.depth_unit_source})`,
    ...(scene.derived ? [scene.derived] : []),
    ...(scene.rig_residual_px > 0.05 ? [`not rectified, by ${scene.rig_residual_px.toPrecision(2)} px`] : []),
  ].join("; ");
  $("frame").max = scene.frames - 1;
  showPairs();
  $("before").disabled = scene.place <= 0;
  $("after").disabled = scene.place + 1 >= state.total;
  keepInSight(scene.place);
  await showRows();
  refresh();
  return true;
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
