/**
 * Heat maps of rooms, and the posterior as one, as in lalaloc_core/draw/heat.py: each place is blurred within its room. The
 * place of the answer is as wide as its covariance, which is finer than the pose grid.
 */

import { h, s } from "./dom";
import { isIn } from "./layout";
import { type Box, boxOf, extentOf, path } from "./plan_drawing";
import type { Answer, PlanDocument, Point, Posterior, RoomDocument } from "./types";

// Places less probable than the best one by this factor are not coloured.
const MIN_RATIO = 1e-5;
// Number of cells along the longer side of a plan, and minimum cell size.
const CELLS = 300,
  MIN_CELL_M = 0.04;
// Standard deviation of the blur in steps of the pose grid, and radius of the kernel in standard deviations.
const DEVIATION = 0.4,
  RADIUS = 5;
// Poses of the grid within this distance (m) of an answer count as the place of the answer.
const SAME_PLACE_M = 1;
// Shade from which colours cover the plan, and opacity from there on.
const OPAQUE_SHADE = 0.3,
  MAX_OPACITY = 0.92;

/** Cells over a room, top row first; `box` is that of the drawing. */
export interface Cells {
  room: RoomDocument;
  box: Box;
  columns: number;
  rows: number;
}

type Field = Cells & { values: Float64Array };

/** Draw a picture for each room with any probability, clipped to its floor. */
export function heatMap(posterior: Posterior, plan: PlanDocument, answer: Refined): SVGGElement {
  const cell = cellSize(plan);
  const fields = plan.rooms.map((room) => fieldOf(posterior, room, cell, answer)).filter((field) => field !== null);
  const best = fields.reduce((most, { values }) => values.reduce((a, b) => Math.max(a, b), most), Number.MIN_VALUE);
  const shaded = fields.map((field) => ({ ...field, values: field.values.map((value) => shadeOf(value, best)) }));
  return roomPictures("posterior", shaded, (shade) => MAX_OPACITY * Math.min(1, shade / OPAQUE_SHADE));
}

/** Place of an answer with its uncertainty. */
type Refined = Pick<Answer, "position" | "covariance_m2">;

export function cellSize(plan: PlanDocument): number {
  const whole = boxOf(plan);
  return Math.max(Math.max(whole.width, whole.height) / CELLS, MIN_CELL_M);
}

/** Cover a room with cells. */
export function cellsOf(room: RoomDocument, cell: number): Cells {
  const { left, right, low, high } = extentOf(room.polygon);
  const columns = Math.ceil((right - left) / cell),
    rows = Math.ceil((high - low) / cell);
  return { room, box: { x: left, y: -high, width: columns * cell, height: rows * cell }, columns, rows };
}

/** Draw shades from 0 to 1 as a picture for each room, clipped to its floor; `name` is unique on the page. */
export function roomPictures(name: string, fields: Field[], opacity: (shade: number) => number): SVGGElement {
  const ramp = rampOf(getComputedStyle(document.documentElement).getPropertyValue("--heat-ramp"));
  return s(
    "g",
    { class: `heat ${name}`, "aria-hidden": "true" },
    ...fields.map((field, index) => {
      const { room, box } = field,
        id = `${name}-${index}`,
        floor = path(room.polygon) + (room.holes ?? []).map(path).join(""),
        href = pictureOf(field, ramp, opacity);
      return s(
        "g",
        {},
        s("clipPath", { id }, s("path", { d: floor, "clip-rule": "evenodd" })),
        s("image", { href, ...box, preserveAspectRatio: "none", "clip-path": `url(#${id})` }),
      );
    }),
  );
}

/** Return the shade of a density on a logarithmic scale: 1 for the best place, 0 for negligible ones. */
function shadeOf(density: number, best: number): number {
  return Math.max(0, 1 - Math.log(Math.max(density / best, MIN_RATIO)) / Math.log(MIN_RATIO));
}

function fieldOf(posterior: Posterior, room: RoomDocument, cell: number, answer: Refined): Field | null {
  const { x_m, y_m } = answer.position,
    isOfAnswer = answer.covariance_m2 !== null && isIn(room, x_m, y_m);
  let own = 0;
  const cells = cellsOf(room, cell),
    { columns, rows, box } = cells;
  const left = box.x,
    high = -box.y;
  let spread: Float64Array | null = null;
  posterior.x_m.forEach((x, index) => {
    const y = posterior.y_m[index]!;
    if (x < left || x > left + box.width || y < high - box.height || y > high || !isIn(room, x, y)) return;
    spread ??= new Float64Array(columns * rows);
    if (isOfAnswer && Math.hypot(x - x_m, y - y_m) < SAME_PLACE_M) own += posterior.probability[index]!;
    else
      splat(spread, columns, rows, [(x - left) / cell - 0.5, (high - y) / cell - 0.5], posterior.probability[index]!);
  });
  if (spread === null) return null;
  const kernel = kernelOf((DEVIATION * posterior.step_m) / cell);
  const values = blurred(blurred(spread, columns, rows, 1, kernel), columns, rows, columns, kernel);
  // As strong at its middle as one pose of this probability, so that places compare by their probabilities.
  if (own > 0) addNormal(values, cells, answer, own * kernel[0]! ** 2);
  return { ...cells, values };
}

/** Add a normal distribution about the place of an answer, with its covariance but no narrower than a cell. */
function addNormal(values: Float64Array, cells: Cells, { position, covariance_m2 }: Refined, peak: number): void {
  const { box, columns, rows } = cells,
    cell = box.width / columns;
  const [[xx, xy], [, yy]] = covariance_m2 as [[number, number], [number, number]];
  const a = xx + (0.5 * cell) ** 2,
    b = yy + (0.5 * cell) ** 2,
    determinant = a * b - xy ** 2;
  values.forEach((value, index) => {
    const dx = box.x + ((index % columns) + 0.5) * cell - position.x_m;
    const dy = -box.y - (Math.floor(index / columns) + 0.5) * (box.height / rows) - position.y_m;
    const square = (b * dx * dx - 2 * xy * dx * dy + a * dy * dy) / determinant;
    values[index] = value + peak * Math.exp(-0.5 * square);
  });
}

/** Distribute a value over the four cells around a place. */
function splat(field: Float64Array, columns: number, rows: number, [x, y]: Point, value: number): void {
  const column = Math.floor(x),
    row = Math.floor(y),
    right = x - column,
    down = y - row;
  for (const j of [0, 1])
    for (const i of [0, 1]) {
      const share = (i === 0 ? 1 - right : right) * (j === 0 ? 1 - down : down);
      const cell = Math.max(0, Math.min(rows - 1, row + j)) * columns + Math.max(0, Math.min(columns - 1, column + i));
      field[cell] = field[cell]! + share * value;
    }
}

/** Return half of a normal distribution's weights, from its mean. */
function kernelOf(deviation: number): number[] {
  const weights = Array.from({ length: Math.ceil(RADIUS * deviation) + 1 }, (_, k) =>
    Math.exp(-0.5 * (k / deviation) ** 2),
  );
  const sum = 2 * weights.reduce((a, b) => a + b) - 1;
  return weights.map((weight) => weight / sum);
}

/** Blur along rows (stride 1) or columns (stride `columns`). */
function blurred(field: Float64Array, columns: number, rows: number, stride: number, kernel: number[]): Float64Array {
  const result = new Float64Array(field.length);
  const along = stride === 1 ? columns : rows;
  field.forEach((value, index) => {
    if (value === 0) return;
    const place = stride === 1 ? index % columns : Math.floor(index / columns);
    for (let k = Math.max(1 - kernel.length, -place); k < kernel.length && place + k < along; k++) {
      result[index + k * stride] = result[index + k * stride]! + value * kernel[Math.abs(k)]!;
    }
  });
  return result;
}

type Colour = [number, number, number];

/** Parse a list of colours such as `#ffffff, #000000`. */
function rampOf(list: string): Colour[] {
  return list
    .split(",")
    .map((colour) => [1, 3, 5].map((start) => parseInt(colour.trim().slice(start, start + 2), 16)) as Colour);
}

function pictureOf({ columns, rows, values }: Field, ramp: Colour[], opacity: (shade: number) => number): string {
  const canvas = h("canvas", { width: columns, height: rows });
  const context = canvas.getContext("2d")!;
  const picture = context.createImageData(columns, rows);
  values.forEach((shade, index) => {
    const place = shade * (ramp.length - 1);
    const low = ramp[Math.floor(place)]!,
      high = ramp[Math.ceil(place)]!,
      share = place % 1;
    const colour = low.map((from, k) => Math.round(from + share * (high[k]! - from)));
    picture.data.set([...colour, Math.round(255 * opacity(shade))], 4 * index);
  });
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL();
}
