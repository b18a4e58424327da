/** Pictures as pixels: decoding, scaling and levelling, as in lalaloc_core/photograph. */

import { rayOf, tiltOf } from "../camera";
import { InputError } from "../input_error";
import type { ViewAnswer } from "../types";

/** RGB by row. */
export interface Pixels {
  width: number;
  height: number;
  rgb: Uint8ClampedArray;
}

// Pixels that are read from the canvas at once, to bound memory; some browsers have no canvas of more than 16 million.
const BAND_PIXELS = 2 ** 21;
// Transparent parts, as in lalaloc_core/photograph/picture_files.py.
const NEUTRAL = "rgb(128, 128, 128)";

/** Decode a picture, upright. */
export async function decoded(file: Blob, name: string): Promise<ImageBitmap> {
  try {
    return await createImageBitmap(file, { imageOrientation: "from-image", colorSpaceConversion: "none" });
  } catch {
    throw new InputError(
      `This browser cannot decode “${name}”. Export it as JPEG, or encode it with the command line (lalaloc encode).`,
    );
  }
}

/** Scale a picture; each pixel is the mean of the area that it covers. */
export function scaled(bitmap: ImageBitmap, width: number, height: number): Pixels {
  const { width: columns, height: rows } = bitmap;
  const sums = new Float32Array(3 * width * height),
    row = new Float32Array(3 * width);
  const most = Math.max(1, Math.min(rows, Math.floor(BAND_PIXELS / columns)));
  const canvas = new OffscreenCanvas(columns, most);
  const context = canvas.getContext("2d", { willReadFrequently: true })!;
  const across = shares(columns, width),
    down = shares(rows, height);
  context.fillStyle = NEUTRAL;
  for (let top = 0; top < rows; top += most) {
    const count = Math.min(most, rows - top);
    context.fillRect(0, 0, columns, count);
    context.drawImage(bitmap, 0, -top);
    const { data } = context.getImageData(0, 0, columns, count);
    for (let y = 0; y < count; y++) {
      row.fill(0);
      let from = 4 * y * columns;
      for (let x = 0; x < columns; x++, from += 4) {
        for (const [place, share] of across[x]!)
          for (let c = 0; c < 3; c++) row[3 * place + c]! += share * data[from + c]!;
      }
      for (const [place, share] of down[top + y]!) {
        const begin = 3 * width * place;
        for (let i = 0; i < row.length; i++) sums[begin + i]! += share * row[i]!;
      }
    }
  }
  return { width, height, rgb: Uint8ClampedArray.from(sums) };
}

/** Return the places that each of `count` pixels has a share in, after scaling to `places`. */
function shares(count: number, places: number): [number, number][][] {
  const size = count / places;
  return Array.from({ length: count }, (_, pixel) => {
    const found: [number, number][] = [];
    for (let place = Math.floor(pixel / size); place < places && place * size < pixel + 1; place++) {
      const share = (Math.min(pixel + 1, (place + 1) * size) - Math.max(pixel, place * size)) / size;
      if (share > 1e-9) found.push([place, share]);
    }
    return found;
  });
}

/** Return a full sphere of half the size, as taken by a level camera with the same heading. */
export function levelled(sphere: Pixels, view: Pick<ViewAnswer, "projection" | "pitch" | "roll">): Pixels {
  const { width, height } = sphere,
    tilt = tiltOf(view),
    turned: Pixels = { width, height, rgb: new Uint8ClampedArray(3 * width * height) };
  for (let row = 0, to = 0; row < height; row++) {
    const elevation = (0.5 - (row + 0.5) / height) * Math.PI;
    for (let column = 0; column < width; column++, to += 3) {
      const azimuth = ((column + 0.5) / width - 0.5) * 2 * Math.PI;
      const [right, forward, up] = tilt(rayOf(azimuth, elevation));
      const x = (Math.atan2(right, forward) / (2 * Math.PI) + 0.5) * width,
        y = (0.5 - Math.asin(Math.max(-1, Math.min(1, up))) / Math.PI) * height;
      sample(sphere, x, y, aroundPoles, turned.rgb, to);
    }
  }
  return halved(turned);
}

type Border = (pixels: Pixels, column: number, row: number) => number;

/** Return the index of a pixel of a full sphere; a row beyond a pole is the row before it, half a turn away. */
const aroundPoles: Border = ({ width, height }, column, row) => {
  const beyond = row < 0 || row >= height;
  const place = (((beyond ? column + (width >> 1) : column) % width) + width) % width;
  return 3 * (Math.max(0, Math.min(height - 1, row)) * width + place);
};

/** Return the index of the nearest pixel of a picture. */
export const nearest: Border = ({ width, height }, column, row) =>
  3 * (Math.max(0, Math.min(height - 1, row)) * width + Math.max(0, Math.min(width - 1, column)));

/** Write the colour at a place, in pixels from the top left corner, bilinear. */
export function sample(
  pixels: Pixels,
  x: number,
  y: number,
  border: Border,
  out: Uint8ClampedArray | Uint8Array,
  to: number,
): void {
  const left = Math.floor(x - 0.5),
    above = Math.floor(y - 0.5),
    across = x - 0.5 - left,
    down = y - 0.5 - above;
  const [a, b] = [border(pixels, left, above), border(pixels, left + 1, above)];
  const [c, d] = [border(pixels, left, above + 1), border(pixels, left + 1, above + 1)];
  const { rgb } = pixels;
  for (let i = 0; i < 3; i++) {
    const upper = rgb[a + i]! * (1 - across) + rgb[b + i]! * across,
      lower = rgb[c + i]! * (1 - across) + rgb[d + i]! * across;
    out[to + i] = Math.round(upper * (1 - down) + lower * down);
  }
}

function halved({ width, height, rgb }: Pixels): Pixels {
  const half: Pixels = { width: width / 2, height: height / 2, rgb: new Uint8ClampedArray(rgb.length / 4) };
  for (let row = 0, to = 0; row < half.height; row++) {
    for (let column = 0; column < half.width; column++) {
      for (let c = 0; c < 3; c++, to++) {
        const from = 3 * (2 * row * width + 2 * column) + c;
        half.rgb[to] = (rgb[from]! + rgb[from + 3]! + rgb[from + 3 * width]! + rgb[from + 3 * width + 3]!) / 4;
      }
    }
  }
  return half;
}

// Limits of `is_sphere` in lalaloc_core/photograph/projection.py.
const MAX_PRODUCT = 0.2,
  MAX_SEAM = 8,
  MAX_POLE = 0.5,
  MIN_CONTRAST = 2;

/** Return whether a picture twice as wide as high looks like a full sphere: its borders continue each other, its poles hardly vary. */
export function looksSpherical({ width, height, rgb }: Pixels): boolean {
  const spread = Array.from({ length: height }, (_, row) => deviation(rgb, row * width, width));
  const margin = height >> 3,
    body = spread.slice(margin, height - margin).sort((a, b) => a - b);
  const middle = body.length >> 1;
  const contrast = body.length % 2 === 1 ? body[middle]! : 0.5 * (body[middle - 1]! + body[middle]!);
  if (contrast < MIN_CONTRAST) return false;
  let step = 0,
    seam = 0;
  for (let row = margin; row < height - margin; row++) {
    const begin = 3 * row * width,
      end = begin + 3 * width;
    for (let i = begin; i < end - 3; i++) step += Math.abs(rgb[i + 3]! - rgb[i]!);
    for (let c = 0; c < 3; c++) seam += Math.abs(rgb[begin + c]! - rgb[end - 3 + c]!);
  }
  const rows = 3 * (height - 2 * margin),
    jump = seam / rows / (step / (rows * (width - 1)) + 0.5);
  const [top, bottom] = [spread[0]!, spread.at(-1)!].map((value) => Math.min((value + 0.5) / (contrast + 0.5), 1)) as [
    number,
    number,
  ];
  return jump < MAX_SEAM && Math.min(top, bottom) < MAX_POLE && jump * top * bottom < MAX_PRODUCT;
}

/** Return the standard deviation along a row, the mean of its colours. */
function deviation(rgb: Uint8ClampedArray, first: number, count: number): number {
  let total = 0;
  for (let c = 0; c < 3; c++) {
    let sum = 0,
      squares = 0;
    for (let i = 0; i < count; i++) {
      const value = rgb[3 * (first + i) + c]!;
      sum += value;
      squares += value * value;
    }
    total += Math.sqrt(Math.max(0, squares / count - (sum / count) ** 2));
  }
  return total / 3;
}
