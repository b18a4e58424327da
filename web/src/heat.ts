/** The posterior as a heat map, drawn as lalaloc_core/draw/heat.py draws it: places spread into their rooms. */

import { s } from "./dom";
import { inside } from "./layout";
import { type Box, boxOf, path } from "./plan_drawing";
import type { PlanDocument, Point, Posterior, RoomDocument } from "./types";

// What is less probable than the best place by this factor is not coloured.
const LEAST = 1e-5;
// Cells along the longer side of a plan, and none smaller than this.
const CELLS = 300, LEAST_CELL_M = 0.04;
// Places are spread by a normal distribution: its deviation in steps of the grid, and how many of them it reaches.
const SPREAD = 0.4, REACH = 5;
// From this shade on colours cover what is below them almost entirely.
const COVERS = 0.3, MOST_COVER = 0.92;

/** A room's part of the map: how dense the probability is in each of its cells, rows from above. */
interface Field {
  room: RoomDocument;
  box: Box;
  columns: number;
  rows: number;
  density: Float64Array;
}

/** A picture for each room that has any probability, cut off at its walls; the likelier a place, the stronger its colour. */
export function heatMap(posterior: Posterior, plan: PlanDocument): SVGGElement {
  const whole = boxOf(plan);
  const cell = Math.max(Math.max(whole.width, whole.height) / CELLS, LEAST_CELL_M);
  const fields = plan.rooms.map((room) => fieldOf(posterior, room, cell)).filter((field) => field !== null);
  const best = fields.reduce((most, { density }) => density.reduce((a, b) => Math.max(a, b), most), Number.MIN_VALUE);
  const ramp = rampOf(getComputedStyle(document.documentElement).getPropertyValue("--heat-ramp"));
  return s("g", { class: "heat", "aria-hidden": "true" }, ...fields.map((field, index) => {
    const { room, box: { x, y, width, height } } = field, id = `floor-${index}`;
    return s("g", {},
      s("clipPath", { id }, s("path", { d: path(room.polygon) + (room.holes ?? []).map(path).join(""), "clip-rule": "evenodd" })),
      s("image", { href: pictureOf(field, best, ramp), x, y, width, height, preserveAspectRatio: "none", "clip-path": `url(#${id})` }));
  }));
}

/** From 0 for what is next to impossible to 1 for the best place, on the scale of the logarithm. */
export function shadeOf(density: number, best: number): number {
  return Math.max(0, 1 - Math.log(Math.max(density / best, LEAST)) / Math.log(LEAST));
}

function fieldOf(posterior: Posterior, room: RoomDocument, cell: number): Field | null {
  const xs = room.polygon.map(([x]) => x), ys = room.polygon.map(([, y]) => y);
  const left = Math.min(...xs), right = Math.max(...xs), low = Math.min(...ys), high = Math.max(...ys);
  const columns = Math.ceil((right - left) / cell), rows = Math.ceil((high - low) / cell);
  let spread: Float64Array | null = null;
  posterior.x_m.forEach((x, index) => {
    const y = posterior.y_m[index]!;
    if (x < left || x > right || y < low || y > high || !inside(room.polygon, x, y)) return;
    if ((room.holes ?? []).some((hole) => inside(hole, x, y))) return;
    spread ??= new Float64Array(columns * rows);
    splat(spread, columns, rows, [(x - left) / cell - 0.5, (high - y) / cell - 0.5], posterior.probability[index]!);
  });
  if (spread === null) return null;
  const kernel = kernelOf((SPREAD * posterior.step_m) / cell);
  const density = blurred(blurred(spread, columns, rows, 1, kernel), columns, rows, columns, kernel);
  return { room, box: { x: left, y: -high, width: columns * cell, height: rows * cell }, columns, rows, density };
}

/** Share a value among the four cells around a place. */
function splat(field: Float64Array, columns: number, rows: number, [x, y]: Point, value: number): void {
  const column = Math.floor(x), row = Math.floor(y), right = x - column, down = y - row;
  for (const [i, j, share] of [[0, 0, (1 - right) * (1 - down)], [1, 0, right * (1 - down)], [0, 1, (1 - right) * down], [1, 1, right * down]] as const) {
    const at = Math.max(0, Math.min(rows - 1, row + j)) * columns + Math.max(0, Math.min(columns - 1, column + i));
    field[at] = field[at]! + share * value;
  }
}

/** Half of a normal distribution's weights, from its middle. */
function kernelOf(deviation: number): number[] {
  const weights = Array.from({ length: Math.ceil(REACH * deviation) + 1 }, (_, k) => Math.exp(-0.5 * (k / deviation) ** 2));
  const sum = 2 * weights.reduce((a, b) => a + b) - 1;
  return weights.map((weight) => weight / sum);
}

/** Blur along rows (stride 1) or columns (stride `columns`). */
function blurred(field: Float64Array, columns: number, rows: number, stride: number, kernel: number[]): Float64Array {
  const made = new Float64Array(field.length);
  const along = stride === 1 ? columns : rows;
  field.forEach((value, index) => {
    if (value === 0) return;
    const place = stride === 1 ? index % columns : Math.floor(index / columns);
    for (let k = Math.max(1 - kernel.length, -place); k < kernel.length && place + k < along; k++) {
      made[index + k * stride] = made[index + k * stride]! + value * kernel[Math.abs(k)]!;
    }
  });
  return made;
}

type Colour = [number, number, number];

/** Colours of a list such as `#ffffff, #000000`. */
function rampOf(list: string): Colour[] {
  return list.split(",").map((colour) => [1, 3, 5].map((at) => parseInt(colour.trim().slice(at, at + 2), 16)) as Colour);
}

function pictureOf({ columns, rows, density }: Field, best: number, ramp: Colour[]): string {
  const canvas = document.createElement("canvas");
  canvas.width = columns;
  canvas.height = rows;
  const context = canvas.getContext("2d")!;
  const picture = context.createImageData(columns, rows);
  density.forEach((value, index) => {
    const shade = shadeOf(value, best), place = shade * (ramp.length - 1);
    const low = ramp[Math.floor(place)]!, high = ramp[Math.ceil(place)]!, share = place % 1;
    const colour = low.map((from, k) => Math.round(from + share * (high[k]! - from)));
    picture.data.set([...colour, Math.round(255 * MOST_COVER * Math.min(1, shade / COVERS))], 4 * index);
  });
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL();
}
