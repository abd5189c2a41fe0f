// Pictures from numbers: the same colours and scales as `stereogenbench show`.

/** A range of values and its colours; "log" runs from red to blue, so that near is red in both. */
export class Scale {
  constructor(low, high, kind = "linear") {
    this.low = low;
    this.high = high;
    this.kind = kind;
  }

  /** Where a value lies in the range: 0 at the low end, 1 at the high one. */
  place(value) {
    const inside = Math.min(Math.max(Math.abs(value), this.low), this.high);
    return this.kind === "log"
      ? Math.log(inside / this.low) / Math.max(Math.log(this.high / this.low), 1e-12)
      : (inside - this.low) / Math.max(this.high - this.low, 1e-12);
  }

  /** At most so many round numbers within the range. */
  ticks(most) {
    for (const numbers of this.#tickSets()) {
      if (numbers.length <= most) return numbers;
    }
    return [];
  }

  * #tickSets() {
    const inside = (number) => number >= this.low && number <= this.high;
    if (this.kind === "log" && this.high > 4 * this.low) {
      for (const factors of [[1, 1.5, 2, 3, 5, 7], [1, 2, 5], [1, 3], [1]]) {
        const numbers = [];
        for (let power = Math.floor(Math.log10(this.low)); power <= Math.log10(this.high); power++) {
          numbers.push(...factors.map((factor) => factor * 10 ** power));
        }
        yield numbers.filter(inside);
      }
    }
    const exponent = Math.floor(Math.log10(Math.max(this.high - this.low, 1e-12))) - 2;
    for (let power = exponent; power < exponent + 4; power++) {
      for (const factor of [1, 2, 5]) {
        const step = factor * 10 ** power;
        const numbers = [];
        for (let n = Math.ceil(this.low / step); n <= Math.floor(this.high / step); n++) {
          numbers.push(Number((n * step).toPrecision(12)));
        }
        yield numbers;
      }
    }
  }
}

/** A scale for the middle 96 % of measured values; a linear one begins at 0 if it can. */
export function scaleOf(values, kind = "linear") {
  const step = Math.max(1, Math.floor(values.length / 40000));
  const found = [];
  for (let i = 0; i < values.length; i += step) {
    if (!Number.isNaN(values[i])) found.push(Math.abs(values[i]));
  }
  if (!found.length) return new Scale(kind === "log" ? 1 : 0, 2, kind);
  found.sort((a, b) => a - b);
  let low = found[Math.round(0.02 * (found.length - 1))];
  const high = found[Math.round(0.98 * (found.length - 1))];
  if (kind === "linear" && low < high / 2) low = 0;
  return new Scale(low, Math.max(high, low * 1.001, low + 1e-6), kind);
}

/** 256 colours between the stops, as one array of red, green, blue. */
export function palette(stops) {
  const colours = new Uint8ClampedArray(256 * 3);
  for (let i = 0; i < 256; i++) {
    const place = (i / 255) * (stops.length - 1);
    const at = Math.min(Math.floor(place), stops.length - 2);
    for (let c = 0; c < 3; c++) {
      colours[3 * i + c] = stops[at][c] + (stops[at + 1][c] - stops[at][c]) * (place - at);
    }
  }
  return colours;
}

/** A map in a scale's colours; nan is not measured. */
export function paintMap(values, scale, colours, grey, image) {
  const pixels = image.data;
  const turned = scale.kind === "log";
  for (let i = 0, p = 0; i < values.length; i++, p += 4) {
    let red = grey[0], green = grey[1], blue = grey[2];
    if (!Number.isNaN(values[i])) {
      const place = scale.place(values[i]);
      const at = 3 * Math.round(255 * (turned ? 1 - place : place));
      red = colours[at];
      green = colours[at + 1];
      blue = colours[at + 2];
    }
    pixels[p] = red;
    pixels[p + 1] = green;
    pixels[p + 2] = blue;
    pixels[p + 3] = 255;
  }
  return image;
}

/** Red of the left picture, green and blue of the right one. */
export function paintAnaglyph(left, right, image) {
  for (let p = 0; p < image.data.length; p += 4) {
    image.data[p] = left.data[p];
    image.data[p + 1] = right.data[p + 1];
    image.data[p + 2] = right.data[p + 2];
    image.data[p + 3] = 255;
  }
  return image;
}

/** The left picture, faint; what the right camera does not see, and what was not measured, in colour. */
export function paintVisible(left, visible, disparity, { hidden, grey }, image) {
  for (let i = 0, p = 0; i < visible.length; i++, p += 4) {
    let colour = hidden;
    if (Number.isNaN(disparity[i])) colour = grey;
    else if (visible[i]) {
      const level = 0.2 * (left.data[p] + left.data[p + 1] + left.data[p + 2]) + 90;
      colour = [level, level, level];
    }
    image.data[p] = colour[0];
    image.data[p + 1] = colour[1];
    image.data[p + 2] = colour[2];
    image.data[p + 3] = 255;
  }
  return image;
}
