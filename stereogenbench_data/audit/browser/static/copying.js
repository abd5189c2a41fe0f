/** Copies a line of Python. */

import { $, isTouched } from "/state.js";

export async function copy(id, button) {
  const before = [...button.childNodes];
  try {
    await navigator.clipboard.writeText($(id).textContent);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren($(id));
    button.textContent = isTouched() ? "Selected" : "Selected: press Ctrl+C";
  }
  setTimeout(() => button.replaceChildren(...before), 1200);
}
