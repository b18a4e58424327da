/**
 * Bare layout around a pose in closed form, as in lalaloc_core/render, for lines over a photograph.
 * Angles are radians, azimuths clockwise from the plan's +y, elevations up from the horizon.
 */

import type { OpeningKind, Point, RoomLayout } from "./types";

// As in lalaloc_core/render/profile.py: rounding can make a ray miss both walls at a corner.
const CORNER_TOLERANCE = 1e-5;
const PARALLEL = 1e-12;
const COLUMNS = 720;
const HALVINGS = 24;
const STEP = Math.PI / 180;

// As in lalaloc_core/floorplan/openings.py: sills and heads (m) of openings whose heights the plan does not give.
export const USUAL_HEIGHTS_M: Record<OpeningKind, Point> = { door: [0, 2.05], window: [0.9, 2.1], passage: [0, 2.2] };

export const radians = (degrees: number): number => (degrees * Math.PI) / 180;
export const degrees = (angle: number): number => (angle * 180) / Math.PI;

/** Return the index of the nearest wall along an azimuth; -1 if there is none. */
function nearestWall(x: number, y: number, azimuth: number, walls: RoomLayout["walls_m"]): number {
  const dx = Math.sin(azimuth),
    dy = Math.cos(azimuth);
  let [nearest, found] = [Infinity, -1];
  walls.forEach(([x0, y0, x1, y1], wall) => {
    const sx = x0 - x,
      sy = y0 - y,
      ex = x1 - x0,
      ey = y1 - y0;
    const determinant = dx * ey - dy * ex;
    if (Math.abs(determinant) < PARALLEL) return;
    const distance = (sx * ey - sy * ex) / determinant;
    const share = (sx * dy - sy * dx) / determinant;
    const hit = distance > 0 && share >= -CORNER_TOLERANCE && share <= 1 + CORNER_TOLERANCE;
    if (hit && distance < nearest) [nearest, found] = [distance, wall];
  });
  return found;
}

/** Line of the layout as directions from the camera: azimuth and elevation of each point. */
export interface LayoutLine {
  kind: "edge" | OpeningKind;
  points: Point[];
}

interface Piece {
  wall: number;
  from: number;
  to: number;
}

/** Return all visible lines of a room: along floor and ceiling, in corners, around openings. */
export function layoutLines(x: number, y: number, room: RoomLayout, cameraHeight: number): LayoutLine[] {
  const pieces = visiblePieces(x, y, room);
  const distanceAt = (wall: number, azimuth: number): number => toWall(x, y, azimuth, room.walls_m[wall]!);
  const elevation = (height: number, distance: number): number => Math.atan2(height - cameraHeight, distance);
  // Where a wall meets floor and ceiling.
  const heights = [0, room.ceiling_height_m];
  const lines: LayoutLine[] = [];
  pieces.forEach(({ wall, from, to }, index) => {
    for (const height of heights)
      lines.push({
        kind: "edge",
        points: sampled(from, to).map((azimuth) => [azimuth, elevation(height, distanceAt(wall, azimuth))]),
      });
    const next = pieces[(index + 1) % pieces.length]!;
    const near = Math.min(distanceAt(wall, to), distanceAt(next.wall, to));
    if (pieces.length > 1) lines.push({ kind: "edge", points: heights.map((height) => [to, elevation(height, near)]) });
    lines.push(...openingLines(x, y, { wall, from, to }, room, cameraHeight));
  });
  return lines;
}

function openingLines(x: number, y: number, piece: Piece, room: RoomLayout, cameraHeight: number): LayoutLine[] {
  const wall = room.walls_m[piece.wall]!,
    [x0, y0, x1, y1] = wall;
  return room.openings
    .filter((opening) => opening.wall === piece.wall)
    .flatMap((opening) => {
      const sides = [opening.start, opening.end]
        .map((share) => {
          const azimuth = Math.atan2(x0 + share * (x1 - x0) - x, y0 + share * (y1 - y0) - y);
          return unwrapped(azimuth, 0.5 * (piece.from + piece.to));
        })
        .sort((a, b) => a - b) as Point;
      const from = Math.max(sides[0], piece.from),
        to = Math.min(sides[1], piece.to);
      if (from >= to) return [];
      const [usualSill, usualHead] = USUAL_HEIGHTS_M[opening.kind];
      const sill = opening.sill_m ?? usualSill,
        head = Math.min(opening.head_m ?? usualHead, room.ceiling_height_m);
      if (sill >= head) return [];
      const along = sampled(from, to);
      const at = (height: number): Point[] =>
        along.map((azimuth) => [azimuth, Math.atan2(height - cameraHeight, toWall(x, y, azimuth, wall))]);
      const lower = at(sill),
        upper = at(head);
      // One line around the opening; a side that another wall hides stays open.
      const whole = sides[0] >= piece.from - 1e-9,
        closed = sides[1] <= piece.to + 1e-9;
      const points = [...upper.reverse(), ...lower];
      if (whole && closed) return [{ kind: opening.kind, points: [...points, upper[0]!] }];
      if (whole) return [{ kind: opening.kind, points }];
      if (closed) return [{ kind: opening.kind, points: [...lower, ...upper] }];
      return [
        { kind: opening.kind, points: lower },
        { kind: opening.kind, points: upper },
      ];
    });
}

/** Return the visible pieces of walls, clockwise, once around. */
function visiblePieces(x: number, y: number, room: RoomLayout): Piece[] {
  const wallAt = (azimuth: number): number => nearestWall(x, y, azimuth, room.walls_m);
  const azimuths = Array.from({ length: COLUMNS }, (_, column) => ((column + 0.5) / COLUMNS - 0.5) * 2 * Math.PI);
  const walls = azimuths.map(wallAt);
  const borders: { azimuth: number; wall: number }[] = [];
  walls.forEach((wall, column) => {
    const previous = walls[(column + COLUMNS - 1) % COLUMNS]!;
    if (wall === previous || wall < 0 || previous < 0) return;
    let low = azimuths[column]! - (2 * Math.PI) / COLUMNS,
      high = azimuths[column]!;
    for (let halving = 0; halving < HALVINGS; halving++) {
      const middle = 0.5 * (low + high);
      if (wallAt(middle) === previous) low = middle;
      else high = middle;
    }
    borders.push({ azimuth: high, wall });
  });
  if (borders.length === 0) return walls[0]! < 0 ? [] : [{ wall: walls[0]!, from: -Math.PI, to: Math.PI }];
  return borders.map(({ azimuth, wall }, index) => {
    const next = borders[(index + 1) % borders.length]!.azimuth;
    return { wall, from: azimuth, to: next > azimuth ? next : next + 2 * Math.PI };
  });
}

function toWall(x: number, y: number, azimuth: number, [x0, y0, x1, y1]: RoomLayout["walls_m"][number]): number {
  const ex = x1 - x0,
    ey = y1 - y0;
  const determinant = Math.sin(azimuth) * ey - Math.cos(azimuth) * ex;
  return Math.abs(determinant) < PARALLEL ? Infinity : ((x0 - x) * ey - (y0 - y) * ex) / determinant;
}

function sampled(from: number, to: number): number[] {
  const steps = Math.max(1, Math.ceil((to - from) / STEP));
  return Array.from({ length: steps + 1 }, (_, step) => from + ((to - from) * step) / steps);
}

function unwrapped(angle: number, near: number): number {
  return angle + 2 * Math.PI * Math.round((near - angle) / (2 * Math.PI));
}

/** Return the room that contains a point, null in walls and outside. */
export function roomAt(rooms: RoomLayout[], x: number, y: number): RoomLayout | null {
  return rooms.find((room) => isIn(room, x, y)) ?? null;
}

type Floor = { polygon: Point[]; holes?: Point[][] | null };

/** Test whether a room contains a point. */
export const isIn = ({ polygon, holes }: Floor, x: number, y: number): boolean =>
  inside(polygon, x, y) && !(holes ?? []).some((hole) => inside(hole, x, y));

/** Test whether a polygon contains a point, by the parity of crossings. */
export function inside(polygon: Point[], x: number, y: number): boolean {
  let odd = false;
  polygon.forEach(([x0, y0], index) => {
    const [x1, y1] = polygon[(index + 1) % polygon.length]!;
    if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) odd = !odd;
  });
  return odd;
}
