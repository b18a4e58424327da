/** Changes of a plan: each returns a new plan; coordinates in metres, rounded to millimetres. */

import { USUAL_HEIGHTS_M } from "../layout";
import { distanceTo } from "../plan_drawing";
import type { AnchorDocument, OpeningDocument, OpeningKind, PlanDocument, Point, RoomDocument } from "../types";

/** Maximum distance of an opening from its wall. */
export const NEAR_WALL_M = 0.35;
const MIN_WIDTH_M = 0.2;
// As in lalaloc_core/floorplan/openings.py: openings that share no more of a wall only touch.
const TOUCHING_M = 0.01;
const DEFAULT_WIDTHS_M: Record<OpeningKind, number> = { door: 0.9, window: 1.2, passage: 1 };

export const rounded = ([x, y]: Point): Point => [Math.round(x * 1000) / 1000, Math.round(y * 1000) / 1000];
const plus = (a: Point, b: Point): Point => rounded([a[0] + b[0], a[1] + b[1]]);

/** A wall of a room: the edge of its outline that begins at a corner. */
export interface WallRef {
  room: number;
  edge: number;
}

export function wallOf(plan: PlanDocument, { room, edge }: WallRef): [Point, Point] {
  const polygon = plan.rooms[room]!.polygon;
  return [polygon[edge]!, polygon[(edge + 1) % polygon.length]!];
}

function withRoom(plan: PlanDocument, index: number, change: (room: RoomDocument) => RoomDocument): PlanDocument {
  return { ...plan, rooms: plan.rooms.map((room, position) => (position === index ? change(room) : room)) };
}

function withOutline(plan: PlanDocument, index: number, change: (polygon: Point[]) => Point[]): PlanDocument {
  const before = plan.rooms[index]!.polygon,
    polygon = change(before);
  const moved = withRoom(plan, index, (room) => ({ ...room, polygon }));
  if (before.length !== polygon.length) return moved;
  return { ...moved, openings: (plan.openings ?? []).map((opening) => carried(opening, before, polygon)) };
}

/** Move an opening along with its wall. */
function carried(opening: OpeningDocument, before: Point[], after: Point[]): OpeningDocument {
  const edge = before.findIndex((corner, index) => {
    const next = before[(index + 1) % before.length]!;
    return opening.line.every((end) => distanceTo(end, corner, next) < NEAR_WALL_M);
  });
  if (edge < 0) return opening;
  const next = (edge + 1) % before.length;
  if (same(before[edge]!, after[edge]!) && same(before[next]!, after[next]!)) return opening;
  const along = frame(before[edge]!, before[next]!),
    to = frame(after[edge]!, after[next]!);
  // Keep the share along the wall and the distance to it.
  const line = opening.line.map((end): Point => {
    const share = along.length === 0 ? 0 : along.along(end) / along.length;
    return rounded(to.point(share * to.length, along.off(end)));
  }) as [Point, Point];
  return { ...opening, line: resized(line, opening.line, to.direction) };
}

/** Restore the width of an opening: walls grow, doors do not. */
function resized(line: [Point, Point], before: [Point, Point], direction: Point): [Point, Point] {
  const width = Math.hypot(before[1][0] - before[0][0], before[1][1] - before[0][1]);
  const middle: Point = [0.5 * (line[0][0] + line[1][0]), 0.5 * (line[0][1] + line[1][1])];
  const way = (line[1][0] - line[0][0]) * direction[0] + (line[1][1] - line[0][1]) * direction[1] < 0 ? -0.5 : 0.5;
  return [
    plus(middle, [-way * width * direction[0], -way * width * direction[1]]),
    plus(middle, [way * width * direction[0], way * width * direction[1]]),
  ];
}

const same = (a: Point, b: Point): boolean => a[0] === b[0] && a[1] === b[1];

function frame(from: Point, to: Point) {
  const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  const direction: Point = length === 0 ? [1, 0] : [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
  return {
    length,
    direction,
    along: ([x, y]: Point): number => (x - from[0]) * direction[0] + (y - from[1]) * direction[1],
    off: ([x, y]: Point): number => (y - from[1]) * direction[0] - (x - from[0]) * direction[1],
    point: (along: number, off: number): Point => [
      from[0] + along * direction[0] - off * direction[1],
      from[1] + along * direction[1] + off * direction[0],
    ],
  };
}

export const moveCorner = (plan: PlanDocument, room: number, corner: number, to: Point): PlanDocument =>
  withOutline(plan, room, (polygon) => polygon.map((point, index) => (index === corner ? rounded(to) : point)));

/** Move both ends of a wall. */
export const moveWall = (plan: PlanDocument, { room, edge }: WallRef, by: Point): PlanDocument =>
  withOutline(plan, room, (polygon) => {
    const next = (edge + 1) % polygon.length;
    return polygon.map((point, index) => (index === edge || index === next ? plus(point, by) : point));
  });

/** Add a corner on a wall. */
export const splitWall = (plan: PlanDocument, { room, edge }: WallRef, corner: Point): PlanDocument =>
  withOutline(plan, room, (polygon) => [...polygon.slice(0, edge + 1), rounded(corner), ...polygon.slice(edge + 1)]);

/** Remove a corner; triangles stay as they are. */
export const removeCorner = (plan: PlanDocument, room: number, corner: number): PlanDocument =>
  plan.rooms[room]!.polygon.length <= 3
    ? plan
    : withOutline(plan, room, (polygon) => polygon.filter((_, index) => index !== corner));

export function addRoom(plan: PlanDocument, polygon: Point[]): PlanDocument {
  const room: RoomDocument = { name: `room ${plan.rooms.length + 1}`, type: "unknown", polygon: polygon.map(rounded) };
  return { ...plan, rooms: [...plan.rooms, room] };
}

export const changeRoom = (plan: PlanDocument, index: number, change: Partial<RoomDocument>): PlanDocument =>
  withRoom(plan, index, (room) => ({ ...room, ...change }));

/** Give all rooms the ceiling height of the plan. */
export function withOneCeiling(plan: PlanDocument): PlanDocument {
  return { ...plan, rooms: plan.rooms.map(({ ceiling_height_m: _, ...room }) => room) };
}

export function removeRoom(plan: PlanDocument, index: number): PlanDocument {
  const removed = plan.rooms[index]?.id;
  const openings = (plan.openings ?? []).map((opening) =>
    opening.rooms && removed ? { ...opening, rooms: opening.rooms.filter((id) => id !== removed) } : opening,
  );
  return {
    ...plan,
    rooms: plan.rooms.filter((_, position) => position !== index),
    openings: openings.filter(({ rooms }) => rooms?.length !== 0),
  };
}

/** Return the wall nearest to a place, and its distance. */
export function nearestWall(plan: PlanDocument, place: Point): { wall: WallRef; distance: number } | null {
  let best: { wall: WallRef; distance: number } | null = null;
  plan.rooms.forEach(({ polygon }, room) =>
    polygon.forEach((corner, edge) => {
      const distance = distanceTo(place, corner, polygon[(edge + 1) % polygon.length]!);
      if (best === null || distance < best.distance) best = { wall: { room, edge }, distance };
    }),
  );
  return best;
}

/** Add an opening of usual size on a wall, as near to a place as it fits. */
export function addOpening(plan: PlanDocument, kind: OpeningKind, wall: WallRef, place: Point): PlanDocument {
  const [from, to] = wallOf(plan, wall),
    along = frame(from, to);
  const width = Math.min(DEFAULT_WIDTHS_M[kind], 0.9 * along.length);
  const middle = clamp(along.along(place), 0.5 * width, along.length - 0.5 * width);
  const line: [Point, Point] = [
    rounded(along.point(middle - 0.5 * width, 0)),
    rounded(along.point(middle + 0.5 * width, 0)),
  ];
  const [sill_m, head_m] = USUAL_HEIGHTS_M[kind];
  const opening: OpeningDocument = { kind, line, sill_m, head_m };
  const next = { ...plan, openings: [...(plan.openings ?? []), opening] };
  // The first opening of a kind makes the kind complete, unless the plan lists no complete kinds.
  const isFirst = !(plan.openings ?? []).some((opening) => opening.kind === kind);
  return plan.opening_kinds && plan.opening_kinds.length > 0 && isFirst ? claimKind(next, kind, true) : next;
}

/** Return the kinds of openings that a plan shows completely; by default those that occur in it. */
export function claimedKinds(plan: PlanDocument): OpeningKind[] {
  const occurring = new Set((plan.openings ?? []).map(({ kind }) => kind));
  return plan.opening_kinds ?? [...occurring].filter((kind) => plan.opening_trust?.[kind] === undefined);
}

/** Set whether a plan shows all openings of a kind: a trust of 1 or 0. */
export function claimKind(plan: PlanDocument, kind: OpeningKind, isComplete: boolean): PlanDocument {
  const otherKinds = claimedKinds(plan).filter((claimed) => claimed !== kind);
  const { [kind]: _, ...trust } = plan.opening_trust ?? {};
  const changed = { ...plan, opening_kinds: isComplete ? [...otherKinds, kind] : otherKinds };
  return plan.opening_trust ? { ...changed, opening_trust: trust } : changed;
}

export function changeOpening(plan: PlanDocument, index: number, change: Partial<OpeningDocument>): PlanDocument {
  return {
    ...plan,
    openings: (plan.openings ?? []).map((opening, position) =>
      position === index ? { ...opening, ...change } : opening,
    ),
  };
}

export function removeOpening(plan: PlanDocument, index: number): PlanDocument {
  return { ...plan, openings: (plan.openings ?? []).filter((_, position) => position !== index) };
}

/** Move the ends of an opening to distances along its direction. */
function withEnds(
  plan: PlanDocument,
  index: number,
  ends: (line: ReturnType<typeof frame>) => [number, number],
): PlanDocument {
  const line = frame(...plan.openings![index]!.line),
    [from, to] = ends(line);
  return changeOpening(plan, index, { line: [rounded(line.point(from, 0)), rounded(line.point(to, 0))] });
}

/** Slide an opening along its direction, as near to a place as possible. */
export const slideOpening = (plan: PlanDocument, index: number, place: Point): PlanDocument =>
  withEnds(plan, index, ({ along, length }) => [along(place) - 0.5 * length, along(place) + 0.5 * length]);

/** Move one end of an opening along its direction. */
export const stretchOpening = (plan: PlanDocument, index: number, end: 0 | 1, place: Point): PlanDocument =>
  withEnds(plan, index, ({ along, length }) =>
    end === 0 ? [Math.min(along(place), length - MIN_WIDTH_M), length] : [0, Math.max(along(place), MIN_WIDTH_M)],
  );

/** Set the width of an opening about its centre. */
export const widenOpening = (plan: PlanDocument, index: number, width: number): PlanDocument =>
  withEnds(plan, index, ({ length }) => [0.5 * (length - width), 0.5 * (length + width)]);

export const widthOf = ({ line: [a, b] }: OpeningDocument): number => Math.hypot(b[0] - a[0], b[1] - a[1]);

/** Return why a changed plan is refused: openings that did not overlap before, and now do; null without any. */
export function overlapIn(plan: PlanDocument, before: PlanDocument): string | null {
  const [now, old] = [plan.openings ?? [], before.openings ?? []];
  for (const [index, opening] of now.entries()) {
    if (old.includes(opening)) continue;
    for (const [k, other] of now.entries()) {
      const overlap = index === k ? 0 : shared(opening, other);
      if (overlap <= TOUCHING_M || shared(old[index], old[k]) > TOUCHING_M) continue;
      const pair = `${opening.kind} ${index + 1} would overlap ${other.kind} ${k + 1}`;
      return (
        `${pair} by ${overlap.toFixed(2)} m; openings may share ${TOUCHING_M} m of a wall. ` +
        "Move or narrow one, or set heights that put one above the other."
      );
    }
  }
  return null;
}

/** Return the length (m) of a wall that two openings share side by side; 0 if one is missing. */
function shared(a: OpeningDocument | undefined, b: OpeningDocument | undefined): number {
  if (a === undefined || b === undefined || isAbove(a, b) || isAbove(b, a)) return 0;
  const line = frame(...a.line);
  if (b.line.some((end) => Math.abs(line.off(end)) >= NEAR_WALL_M)) return 0;
  const [from, to] = [line.along(b.line[0]), line.along(b.line[1])];
  return Math.min(Math.max(from, to), line.length) - Math.max(Math.min(from, to), 0);
}

const isAbove = ({ sill_m: sill }: OpeningDocument, { head_m: head }: OpeningDocument): boolean =>
  sill != null && head != null && sill >= head;

/** Return a sentence on rooms whose types a stored plan has from their names; "" without any. */
export function typesByName(sent: PlanDocument, stored: PlanDocument): string {
  const found = stored.rooms.filter(({ type }, index) => type && type !== (sent.rooms[index]?.type ?? "unknown"));
  return found.length === 0 ? "" : ` Types of rooms: ${found.map(({ name, type }) => `${name}: ${type}`).join(", ")}.`;
}

/** Scale the whole plan, except heights. */
export function scaled(plan: PlanDocument, factor: number): PlanDocument {
  const all = (points: Point[]): Point[] => points.map(([x, y]) => rounded([factor * x, factor * y]));
  const known = plan.anchor?.control_points?.map((point) => ({ ...point, x: factor * point.x, y: factor * point.y }));
  const anchor = known && { ...plan.anchor, control_points: known as AnchorDocument["control_points"] };
  const scaledRoom = (room: RoomDocument): RoomDocument => ({
    ...room,
    polygon: all(room.polygon),
    ...(room.holes ? { holes: room.holes.map(all) } : {}),
    ...(room.walls ? { walls: room.walls.map((wall) => all(wall) as [Point, Point]) } : {}),
  });
  return {
    ...plan,
    ...(anchor && { anchor }),
    rooms: plan.rooms.map(scaledRoom),
    openings: (plan.openings ?? []).map((opening) => ({ ...opening, line: all(opening.line) as [Point, Point] })),
    ...(plan.fixtures ? { fixtures: plan.fixtures.map((f) => ({ ...f, outline: all(f.outline) })) } : {}),
  };
}

const clamp = (value: number, low: number, high: number): number => Math.max(low, Math.min(high, value));

/** Snap a place to the coordinates of nearby corners, so that walls become straight. */
export function snapped(plan: PlanDocument, place: Point, within: number, besides: Point | null = null): Point {
  const corners = plan.rooms
    .flatMap(({ polygon }) => polygon)
    .filter((corner) => besides === null || !same(corner, besides));
  const nearest = (axis: 0 | 1): number =>
    corners.reduce(
      (best, corner) => (Math.abs(corner[axis] - place[axis]) < Math.abs(best - place[axis]) ? corner[axis] : best),
      Infinity,
    );
  const [x, y] = [nearest(0), nearest(1)];
  return [
    Math.abs(x - place[0]) < within ? x : Math.round(place[0] * 100) / 100,
    Math.abs(y - place[1]) < within ? y : Math.round(place[1] * 100) / 100,
  ];
}
