/** Floor plan as SVG: one unit is one metre, y is negated. */

import { s, show } from "./dom";
import { inside } from "./layout";
import type { OpeningDocument, Plan, PlanDocument, Point } from "./types";

export interface Box {
  x: number;
  y: number;
  width: number;
  height: number;
}

const MARGIN = 0.06;
// Half of the drawn thickness of a wall between two rooms.
const WALL_M = 0.12;

/** Return the areas of the plan's file that became no room. */
export const lostAreas = (plan: Plan | null): Point[][] => plan?.import_report?.no_room ?? [];

/** Return the smallest and the largest coordinates of points. */
export function extentOf(points: Point[]) {
  const xs = points.map(([x]) => x),
    ys = points.map(([, y]) => y);
  return { left: Math.min(...xs), right: Math.max(...xs), low: Math.min(...ys), high: Math.max(...ys) };
}

/** Return the box around a plan and areas that became no room, with a margin. */
export function boxOf(plan: PlanDocument, lost: Point[][] = []): Box {
  const points = [...plan.rooms.map((room) => room.polygon), ...lost].flat();
  if (points.length === 0) return { x: -1, y: -9, width: 12, height: 10 };
  const { left, right, low, high } = extentOf(points),
    margin = MARGIN * Math.max(right - left, high - low, 1);
  return { x: left - margin, y: -high - margin, width: right - left + 2 * margin, height: high - low + 2 * margin };
}

export const path = (polygon: Point[]): string =>
  polygon.map(([x, y], index) => `${index === 0 ? "M" : "L"}${x} ${-y}`).join("") + "Z";

/** Return the attributes of a line. */
export const ends = ([[ax, ay], [bx, by]]: [Point, Point]) => ({ x1: ax, y1: -ay, x2: bx, y2: -by });

/** Return the unit for texts and handles, which have the same size on every plan. */
export const unitOf = (box: Box): number => Math.max(box.width, box.height) / 100;

/** Draw rooms, openings and areas that became no room into a group. */
export function drawPlan(group: SVGGElement, plan: PlanDocument, lost: Point[][]): void {
  const rooms = plan.rooms.map((room) => {
    const whole = path(room.polygon) + (room.holes ?? []).map(path).join("");
    return s("path", { class: `room ${room.type ?? "unknown"}`, d: whole, "fill-rule": "evenodd" });
  });
  const walls = plan.rooms
    .flatMap((room) => room.walls ?? [])
    .map((wall) => s("line", { class: "wall", ...ends(wall) }));
  // Walls are strokes around floors; the strokes of adjacent rooms meet.
  const solid = s("path", {
    class: "solid",
    d: plan.rooms.map((room) => path(room.polygon)).join(""),
    "stroke-width": 2 * WALL_M,
  });
  show(
    group,
    ...lost.map((area) => s("path", { class: "no-room", d: path(area) })),
    solid,
    ...rooms,
    ...walls,
    ...(plan.openings ?? []).map(openingShape),
  );
}

/** Draw names, north arrow and scale bar into a group on top of the drawing. */
export function drawNames(group: SVGGElement, plan: PlanDocument, box: Box, lost: Point[][]): void {
  const unit = unitOf(box),
    named = plan.rooms.map((room, index): [Point[], string] => [room.polygon, room.name || `room ${index + 1}`]);
  show(
    group,
    ...[...named, ...lost.map((area): [Point[], string] => [area, "no room"])].flatMap(([polygon, name]) => {
      const [[x, y], clearance] = labelPlace(polygon);
      const size = Math.min(2.2 * unit, (3.4 * clearance) / Math.max(name.length, 4));
      return size < 0.8 * unit
        ? []
        : [s("text", { class: "name", x, y: -y + 0.35 * size, "font-size": size.toFixed(3) }, name)];
    }),
    scaleBar(box),
    north(plan, box),
  );
}

function openingShape(opening: OpeningDocument): SVGGElement {
  const line = ends(opening.line);
  // A wall-wide stroke in the colour of the floor interrupts the wall.
  return s(
    "g",
    { class: `opening ${opening.kind}` },
    s("line", { class: "gap", "stroke-width": 2.1 * WALL_M, ...line }),
    s("line", { class: "leaf", ...line }),
  );
}

const RASTER = 24;

/** Return the raster point farthest from the walls of a room, and its distance to them. */
function labelPlace(polygon: Point[]): [Point, number] {
  const { left, right, low, high } = extentOf(polygon);
  let best: [Point, number] = [polygon[0]!, -1];
  for (let row = 1; row < RASTER; row++) {
    for (let column = 1; column < RASTER; column++) {
      const place: Point = [left + ((right - left) * column) / RASTER, low + ((high - low) * row) / RASTER];
      if (!inside(polygon, ...place)) continue;
      const clearance = Math.min(
        ...polygon.map((from, index) => distanceTo(place, from, polygon[(index + 1) % polygon.length]!)),
      );
      // Prefer the centre among equally good points.
      const aside = Math.hypot(column / RASTER - 0.5, row / RASTER - 0.5);
      if (clearance * (1 - 0.1 * aside) > best[1]) best = [place, clearance];
    }
  }
  return best;
}

export function distanceTo([x, y]: Point, [ax, ay]: Point, [bx, by]: Point): number {
  const ex = bx - ax,
    ey = by - ay,
    square = ex * ex + ey * ey;
  const share = square === 0 ? 0 : Math.max(0, Math.min(1, ((x - ax) * ex + (y - ay) * ey) / square));
  return Math.hypot(x - ax - share * ex, y - ay - share * ey);
}

function scaleBar(box: Box): SVGGElement {
  const length = [0.1, 0.5, 1, 2, 5, 10, 20, 50, 100].find((metres) => metres > 0.1 * box.width) ?? 100;
  const unit = unitOf(box),
    x = box.x + 1.5 * unit,
    y = box.y + box.height - 1.5 * unit;
  return s(
    "g",
    { class: "scale", "aria-hidden": "true" },
    s("path", { d: `M${x} ${y - 0.6 * unit}v${0.6 * unit}h${length}v${-0.6 * unit}` }),
    s("text", { x: x + length + unit, y: y + 0.4 * unit, "font-size": 1.7 * unit, class: "start" }, `${length} m`),
  );
}

function north(plan: PlanDocument, box: Box): SVGGElement | null {
  if (plan.north_deg === null || plan.north_deg === undefined) return null;
  const unit = unitOf(box);
  return s(
    "g",
    { class: "north", transform: `translate(${box.x + box.width - 2.4 * unit} ${box.y + box.height - 3.6 * unit})` },
    s("path", {
      d: `M0 ${-2 * unit}L${0.8 * unit} ${unit}L0 ${0.4 * unit}L${-0.8 * unit} ${unit}Z`,
      transform: `rotate(${plan.north_deg})`,
    }),
    s("text", { y: 2.8 * unit, "font-size": 1.8 * unit }, "N"),
  );
}
