/** Tools that take points on the plan: drawing rooms, placing openings, measuring. */

import { s, show } from "../dom";
import { path } from "../plan_drawing";
import { placeOf } from "../pose_marker";
import type { OpeningKind, PlanDocument, Point } from "../types";
import * as change from "./changes";

export type Tool = "select" | "room" | OpeningKind | "scale";

export interface ToolActions {
  /** A plan with another room or opening; returns false if it is refused. */
  edit: (plan: PlanDocument) => boolean;
  done: () => void;
  /** Two points were clicked; their distance as drawn. */
  measured: (distance: number) => void;
  instruct: (text: string) => void;
}

const HINTS: Record<Tool, string> = {
  select:
    "Drag corners, walls and openings; double-click a wall for a new corner, a corner to remove it. A click beside the rooms shows the form of the whole plan.",
  room: "Click the corners of the room along the inner faces of its walls; click the first corner again to close the room. Escape cancels.",
  door: "Click a wall where the door is.",
  window: "Click a wall where the window is.",
  passage: "Click a wall where the passage is.",
  scale: "Click two points with a known distance.",
};
const CLOSE_UNITS = 2;
const MAX_OFFSET_UNITS = 4;

export class Tools {
  readonly element = s("g", { class: "tool" });
  current: Tool = "select";
  private points: Point[] = [];
  private unit = 0.1;
  private plan: PlanDocument = { rooms: [] };

  constructor(
    private readonly svg: SVGSVGElement,
    private readonly actions: ToolActions,
  ) {
    // Capture runs before the listeners of handles and viewport.
    svg.addEventListener("pointerdown", (event) => this.onDown(event), { capture: true });
    svg.addEventListener("pointermove", (event) => {
      if (this.points.length > 0) this.draw(this.snap(placeOf(svg, event)));
    });
    addEventListener("keydown", (event) => {
      if (this.current === "select") return;
      if (event.key === "Escape") this.choose("select");
      if (event.key === "Enter" && this.current === "room" && this.points.length > 2) this.close();
    });
  }

  choose(tool: Tool): void {
    const wasOther = tool !== this.current;
    this.current = tool;
    this.points = [];
    this.svg.classList.toggle("pointing", tool !== "select");
    this.actions.instruct(HINTS[tool]);
    this.draw(null);
    if (wasOther && tool === "select") this.actions.done();
  }

  update(plan: PlanDocument, unit: number): void {
    this.plan = plan;
    this.unit = unit;
  }

  private snap(place: Point): Point {
    const previous = this.points.at(-1);
    const within = this.unit;
    const to = change.snapped(this.plan, place, within);
    // Snap nearly straight walls, as most are parallel to the axes.
    if (this.current !== "room" || previous === undefined) return to;
    const first = this.points[0]!;
    const align = (axis: 0 | 1): number =>
      [previous[axis], first[axis]].find((value) => Math.abs(value - place[axis]) < within) ?? to[axis];
    return [align(0), align(1)];
  }

  private onDown(event: PointerEvent): void {
    if (this.current === "select" || event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    const place = placeOf(this.svg, event);
    if (this.current === "room") this.addCorner(this.snap(place), place);
    else if (this.current === "scale") this.addMeasured(place);
    else this.putOpening(this.current, place);
  }

  private addCorner(corner: Point, place: Point): void {
    const first = this.points[0];
    const closes =
      first !== undefined &&
      this.points.length > 2 &&
      Math.hypot(place[0] - first[0], place[1] - first[1]) < CLOSE_UNITS * this.unit;
    if (closes) this.close();
    else {
      this.points.push(corner);
      this.draw(null);
    }
  }

  private close(): void {
    const plan = change.addRoom(this.plan, this.points);
    this.points = [];
    this.actions.edit(plan);
    this.choose("select");
  }

  private addMeasured(place: Point): void {
    if (this.points.length === 2) this.points = [];
    this.points.push(place);
    this.draw(null);
    const [from, to] = this.points;
    if (from !== undefined && to !== undefined) this.actions.measured(Math.hypot(to[0] - from[0], to[1] - from[1]));
  }

  private putOpening(kind: OpeningKind, place: Point): void {
    const nearest = change.nearestWall(this.plan, place);
    if (nearest === null || nearest.distance > Math.max(MAX_OFFSET_UNITS * this.unit, change.NEAR_WALL_M))
      return this.actions.instruct(`No wall is close enough. ${HINTS[kind]}`);
    if (this.actions.edit(change.addOpening(this.plan, kind, nearest.wall, place))) this.choose("select");
  }

  private draw(ahead: Point | null): void {
    const points =
      ahead === null || (this.current === "scale" && this.points.length === 2) ? this.points : [...this.points, ahead];
    show(
      this.element,
      points.length > 1 && s("path", { class: "drawn", d: path(points).slice(0, -1) }),
      ...this.points.map(([x, y]) => s("circle", { cx: x, cy: -y, r: 0.9 * this.unit, class: "corner" })),
    );
  }
}
