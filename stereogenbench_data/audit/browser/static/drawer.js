/** On a narrow page: the drawer that holds filters and list. A wide page shows them beside. */

import { $, plural } from "/state.js";

export function openDrawer(focus = null) {
  document.body.classList.add("drawn");
  $("open-drawer").ariaExpanded = "true";
  (focus instanceof HTMLElement ? focus : $("drawer")).focus();
}

export function closeDrawer() {
  if (!document.body.classList.contains("drawn")) return;
  document.body.classList.remove("drawn");
  $("open-drawer").ariaExpanded = "false";
  if (getComputedStyle($("open-drawer")).display !== "none") $("open-drawer").focus();
}

/** Say on the button what is behind it. */
export function showDrawerButton(scenes, filters) {
  const set = filters ? `, ${plural(filters, "filter")}` : "";
  $("open-drawer").textContent = `☰ ${plural(scenes, "scene")}${set}`;
}

document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") closeDrawer();
});
