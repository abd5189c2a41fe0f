/** Asks the server, and keeps the last pictures and maps that it gave. */

import { state } from "/state.js";

const KEPT_BYTES = 192 * 2 ** 20;
const FILES = {
  left: "/left.jpg", right: "/right.jpg", disparity: "/disparity.f32", depth: "/depth.f32",
  visible: "/visible.u8",
};

class Refused extends Error {}

export async function ask(url, kind = "json") {
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
export function read(name, moment) {
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
