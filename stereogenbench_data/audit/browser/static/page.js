/** Starts the page: what it is about, and what its controls do. */

import { choose, selectScene, showRows, step } from "/choosing.js";
import { copy } from "/copying.js";
import { closeDrawer, openDrawer } from "/drawer.js";
import { pressed } from "/keys.js";
import { play, selectFrame, selectView } from "/moment.js";
import { buildPanes, fitPanes } from "/panes.js";
import { ask } from "/reading.js";
import { $, SHOWN, VIEWS, plural, state, tell, writePath } from "/state.js";
import { palette } from "/views.js";

function reset() {
  $("filters").reset();
  choose();
}

function listen() {
  let waiting = 0;
  $("filters").addEventListener("input", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => choose(), 150);
  });
  $("filters").addEventListener("change", (event) => {
    if (event.target.name === "bin") ["low", "high"].forEach((end) => { $(`baseline-${end}`).value = ""; });
    if (event.target.id.startsWith("baseline-")) {
      $("facet-bin").querySelectorAll("input:checked").forEach((box) => { box.checked = false; });
    }
  });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("reset").addEventListener("click", reset);
  $("reset-all").addEventListener("click", reset);
  $("open-drawer").addEventListener("click", openDrawer);
  $("close-drawer").addEventListener("click", closeDrawer);
  $("backdrop").addEventListener("click", closeDrawer);
  $("before").addEventListener("click", () => step(-1));
  $("after").addEventListener("click", () => step(1));
  $("list").addEventListener("scroll", () => showRows());
  $("frame").addEventListener("input", () => selectFrame(Number($("frame").value)));
  $("play").addEventListener("click", play);
  $("copy-sample").addEventListener("click", () => copy("sample-line", $("copy-sample")));
  $("copy-selection").addEventListener("click", () => copy("selection-line", $("copy-selection")));
  $("help-button").addEventListener("click", () => $("help").showModal());
  $("left-out").addEventListener("click", () => $("left-out-list").showModal());
  document.addEventListener("keydown", pressed);
  window.addEventListener("unhandledrejection", (event) => tell($("error"), event.reason.message));
  window.addEventListener("hashchange", follow);
  window.addEventListener("resize", () => { fitPanes(); showRows(); });
}

function showAbout() {
  const { about } = state;
  state.colours = palette(about.colours.stops);
  $("data").textContent = about.data;
  document.title = `${about.data.split("/").filter(Boolean).pop() ?? ""} - StereoGenBench scenes`;
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

/** Show what the address names: filters, sample and view. */
async function follow() {
  const place = new URLSearchParams(location.hash.slice(1));
  const filters = new URLSearchParams(place);
  SHOWN.forEach((name) => filters.delete(name));
  if (!filters.has("pairs")) filters.set("pairs", "all");
  if (place.get("view") in VIEWS) selectView(place.get("view"));
  state.choice = filters.toString();
  let refused = "";
  if (place.has("key")) {
    const pair = (place.get("pair") ?? "").split("-").map(Number);
    const frame = Math.max(0, Math.trunc(Number(place.get("frame")) || 0));
    if (!await selectScene(place.get("key"), { pair, frame })) refused = $("error").textContent;
  }
  await choose(state.choice);
  if (refused) {
    writePath($("notice"), `${refused.split(/\.? Did you mean/)[0]}. Another scene is shown.`);
    $("notice").hidden = false;
  }
}

async function start() {
  state.about = await ask("/api/about");
  showAbout();
  buildPanes();
  listen();
  await follow();
  document.body.dataset.ready = "yes";
}

start().catch((error) => tell($("error"), error.message));
