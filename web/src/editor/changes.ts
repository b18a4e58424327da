/** Changes of a plan: each takes a plan and gives another; coordinates in metres, rounded to millimetres. */

import { distanceTo } from "../plan_drawing";
import type { OpeningDocument, OpeningKind, PlanDocument, Point, RoomDocument } from "../types";

/** How far from a wall an opening still belongs to it. */
export const NEAR_WALL_M = 0.35;
const LEAST_WIDTH_M = 0.2;
export const USUAL_WIDTHS_M: Record<OpeningKind, number> = { door: 0.9, window: 1.2, passage: 1 };
const USUAL_HEIGHTS: Record<OpeningKind, { sill_m: number; head_m: number }> = {
  door: { sill_m: 0, head_m: 2 }, window: { sill_m: 0.9, head_m: 2.1 }, passage: { sill_m: 0, head_m: 2.1 },
};

export const rounded = ([x, y]: Point): Point => [Math.round(x * 1000) / 1000, Math.round(y * 1000) / 1000];
const plus = (a: Point, b: Point): Point => rounded([a[0] + b[0], a[1] + b[1]]);

/** A wall of a room: the edge of its outline that begins at a corner. */
export interface WallRef {
  room: number;
  edge: number;
}

/** Both ends of a wall. */
export function wallOf(plan: PlanDocument, { room, edge }: WallRef): [Point, Point] {
  const polygon = plan.rooms[room]!.polygon;
  return [polygon[edge]!, polygon[(edge + 1) % polygon.length]!];
}

function withRoom(plan: PlanDocument, index: number, change: (room: RoomDocument) => RoomDocument): PlanDocument {
  return { ...plan, rooms: plan.rooms.map((room, at) => (at === index ? change(room) : room)) };
}

function withOutline(plan: PlanDocument, index: number, polygon: Point[]): PlanDocument {
  const before = plan.rooms[index]!.polygon;
  const moved = withRoom(plan, index, (room) => ({ ...room, polygon }));
  if (before.length !== polygon.length) return moved;
  return { ...moved, openings: (plan.openings ?? []).map((opening) => carried(opening, before, polygon)) };
}

/** An opening on a wall that moves goes along with it. */
function carried(opening: OpeningDocument, before: Point[], after: Point[]): OpeningDocument {
  const edge = before.findIndex((corner, index) => {
    const next = before[(index + 1) % before.length]!;
    return opening.line.every((end) => distanceTo(end, corner, next) < NEAR_WALL_M);
  });
  if (edge < 0) return opening;
  const next = (edge + 1) % before.length;
  if (same(before[edge]!, after[edge]!) && same(before[next]!, after[next]!)) return opening;
  const along = frame(before[edge]!, before[next]!), to = frame(after[edge]!, after[next]!);
  // As far along from the corner, and as far off the wall, as before.
  const line = opening.line.map((end): Point => {
    const share = along.length === 0 ? 0 : along.along(end) / along.length;
    return rounded(to.point(share * to.length, along.off(end)));
  }) as [Point, Point];
  return { ...opening, line: resized(line, opening.line, to.direction) };
}

/** The width of an opening stays: walls grow, doors do not. */
function resized(line: [Point, Point], before: [Point, Point], direction: Point): [Point, Point] {
  const width = Math.hypot(before[1][0] - before[0][0], before[1][1] - before[0][1]);
  const middle: Point = [0.5 * (line[0][0] + line[1][0]), 0.5 * (line[0][1] + line[1][1])];
  const way = (line[1][0] - line[0][0]) * direction[0] + (line[1][1] - line[0][1]) * direction[1] < 0 ? -0.5 : 0.5;
  return [plus(middle, [-way * width * direction[0], -way * width * direction[1]]),
    plus(middle, [way * width * direction[0], way * width * direction[1]])];
}

const same = (a: Point, b: Point): boolean => a[0] === b[0] && a[1] === b[1];

function frame(from: Point, to: Point): {
  length: number; direction: Point; along: (point: Point) => number; off: (point: Point) => number; point: (along: number, off: number) => Point;
} {
  const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  const direction: Point = length === 0 ? [1, 0] : [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
  return {
    length, direction,
    along: ([x, y]) => (x - from[0]) * direction[0] + (y - from[1]) * direction[1],
    off: ([x, y]) => (y - from[1]) * direction[0] - (x - from[0]) * direction[1],
    point: (along, off) => [from[0] + along * direction[0] - off * direction[1], from[1] + along * direction[1] + off * direction[0]],
  };
}

export function moveCorner(plan: PlanDocument, room: number, corner: number, to: Point): PlanDocument {
  return withOutline(plan, room, plan.rooms[room]!.polygon.map((point, at) => (at === corner ? rounded(to) : point)));
}

/** Move both ends of a wall. */
export function moveWall(plan: PlanDocument, { room, edge }: WallRef, by: Point): PlanDocument {
  const polygon = plan.rooms[room]!.polygon, next = (edge + 1) % polygon.length;
  return withOutline(plan, room, polygon.map((point, at) => (at === edge || at === next ? plus(point, by) : point)));
}

/** A new corner on a wall. */
export function splitWall(plan: PlanDocument, { room, edge }: WallRef, at: Point): PlanDocument {
  const polygon = plan.rooms[room]!.polygon;
  return withOutline(plan, room, [...polygon.slice(0, edge + 1), rounded(at), ...polygon.slice(edge + 1)]);
}

/** Without a corner; a triangle keeps all of its. */
export function removeCorner(plan: PlanDocument, room: number, corner: number): PlanDocument {
  const polygon = plan.rooms[room]!.polygon;
  return polygon.length <= 3 ? plan : withOutline(plan, room, polygon.filter((_, at) => at !== corner));
}

export function addRoom(plan: PlanDocument, polygon: Point[]): PlanDocument {
  const room: RoomDocument = { name: `room ${plan.rooms.length + 1}`, type: "unknown", polygon: polygon.map(rounded) };
  return { ...plan, rooms: [...plan.rooms, room] };
}

export function changeRoom(plan: PlanDocument, index: number, change: Partial<RoomDocument>): PlanDocument {
  return withRoom(plan, index, (room) => ({ ...room, ...change }));
}

export function removeRoom(plan: PlanDocument, index: number): PlanDocument {
  const gone = plan.rooms[index]?.id;
  const openings = (plan.openings ?? []).map((opening) => (opening.rooms && gone ?
    { ...opening, rooms: opening.rooms.filter((id) => id !== gone) } : opening));
  return { ...plan, rooms: plan.rooms.filter((_, at) => at !== index), openings: openings.filter(({ rooms }) => rooms?.length !== 0) };
}

/** The wall that is nearest to a place, with how far off it is. */
export function nearestWall(plan: PlanDocument, place: Point): { wall: WallRef; distance: number } | null {
  let best: { wall: WallRef; distance: number } | null = null;
  plan.rooms.forEach(({ polygon }, room) => polygon.forEach((corner, edge) => {
    const distance = distanceTo(place, corner, polygon[(edge + 1) % polygon.length]!);
    if (best === null || distance < best.distance) best = { wall: { room, edge }, distance };
  }));
  return best;
}

/** A door, window or passage of usual size on a wall, as near to a place as it fits. */
export function addOpening(plan: PlanDocument, kind: OpeningKind, wall: WallRef, place: Point): PlanDocument {
  const [from, to] = wallOf(plan, wall), along = frame(from, to);
  const width = Math.min(USUAL_WIDTHS_M[kind], 0.9 * along.length);
  const middle = clamp(along.along(place), 0.5 * width, along.length - 0.5 * width);
  const line: [Point, Point] = [rounded(along.point(middle - 0.5 * width, 0)), rounded(along.point(middle + 0.5 * width, 0))];
  const opening: OpeningDocument = { kind, line, ...USUAL_HEIGHTS[kind] };
  const next = { ...plan, openings: [...(plan.openings ?? []), opening] };
  // A plan that has shown none of a kind shows all of them with its first; one that has some says itself whether it does.
  const isFirst = !(plan.openings ?? []).some((one) => one.kind === kind);
  return plan.opening_kinds && plan.opening_kinds.length > 0 && isFirst ? claimKind(next, kind, true) : next;
}

/** The kinds of openings that a plan shows completely, so that they count as evidence; those in it where it does not say. */
export function claimedKinds(plan: PlanDocument): OpeningKind[] {
  return plan.opening_kinds ?? [...new Set((plan.openings ?? []).map(({ kind }) => kind))];
}

/** Say that a plan shows all openings of a kind, or that it does not. */
export function claimKind(plan: PlanDocument, kind: OpeningKind, isComplete: boolean): PlanDocument {
  const others = claimedKinds(plan).filter((one) => one !== kind);
  return { ...plan, opening_kinds: isComplete ? [...others, kind] : others };
}

export function changeOpening(plan: PlanDocument, index: number, change: Partial<OpeningDocument>): PlanDocument {
  return { ...plan, openings: (plan.openings ?? []).map((opening, at) => (at === index ? { ...opening, ...change } : opening)) };
}

export function removeOpening(plan: PlanDocument, index: number): PlanDocument {
  return { ...plan, openings: (plan.openings ?? []).filter((_, at) => at !== index) };
}

/** Slide an opening so that its middle is as near to a place as its direction allows. */
export function slideOpening(plan: PlanDocument, index: number, place: Point): PlanDocument {
  const line = plan.openings![index]!.line, along = frame(...line);
  const by = along.along(place) - 0.5 * along.length;
  return changeOpening(plan, index, { line: [rounded(along.point(by, 0)), rounded(along.point(by + along.length, 0))] });
}

/** Move one end of an opening along its direction. */
export function stretchOpening(plan: PlanDocument, index: number, end: 0 | 1, place: Point): PlanDocument {
  const line = plan.openings![index]!.line, along = frame(...line);
  const at = along.along(place);
  const [from, to] = end === 0 ? [Math.min(at, along.length - LEAST_WIDTH_M), along.length] : [0, Math.max(at, LEAST_WIDTH_M)];
  return changeOpening(plan, index, { line: [rounded(along.point(from, 0)), rounded(along.point(to, 0))] });
}

/** Set the width of an opening about its middle. */
export function widenOpening(plan: PlanDocument, index: number, width: number): PlanDocument {
  const line = plan.openings![index]!.line, along = frame(...line);
  const from = 0.5 * (along.length - width);
  return changeOpening(plan, index, { line: [rounded(along.point(from, 0)), rounded(along.point(from + width, 0))] });
}

export const widthOf = ({ line: [a, b] }: OpeningDocument): number => Math.hypot(b[0] - a[0], b[1] - a[1]);

/** The whole plan in another scale; heights stay. */
export function scaled(plan: PlanDocument, factor: number): PlanDocument {
  const all = (points: Point[]): Point[] => points.map(([x, y]) => rounded([factor * x, factor * y]));
  const room = (one: RoomDocument): RoomDocument => ({
    ...one, polygon: all(one.polygon),
    ...(one.holes ? { holes: one.holes.map(all) } : {}),
    ...(one.walls ? { walls: one.walls.map((wall) => all(wall) as [Point, Point]) } : {}),
  });
  return {
    ...plan, rooms: plan.rooms.map(room),
    openings: (plan.openings ?? []).map((opening) => ({ ...opening, line: all(opening.line) as [Point, Point] })),
  };
}

const clamp = (value: number, low: number, high: number): number => Math.max(low, Math.min(high, value));

/** A place moved onto the lines of corners that it nearly lies on, so that walls become straight. */
export function snapped(plan: PlanDocument, place: Point, within: number, besides: Point | null = null): Point {
  const corners = plan.rooms.flatMap(({ polygon }) => polygon).filter((corner) => besides === null || !same(corner, besides));
  const nearest = (axis: 0 | 1): number => corners.reduce((best, corner) =>
    (Math.abs(corner[axis] - place[axis]) < Math.abs(best - place[axis]) ? corner[axis] : best), Infinity);
  const [x, y] = [nearest(0), nearest(1)];
  return [Math.abs(x - place[0]) < within ? x : Math.round(place[0] * 100) / 100, Math.abs(y - place[1]) < within ? y : Math.round(place[1] * 100) / 100];
}
