/** Handles of corners, walls and openings, for pointer and keyboard. */

import { ARROWS, followPointer, s, showKeepingFocus } from "../dom";
import { ends, path } from "../plan_drawing";
import { placeOf } from "../pose_marker";
import type { OpeningKind, PlanDocument, Point } from "../types";
import * as change from "./changes";

export type Selection = { kind: "none" } | { kind: "room"; index: number } | { kind: "opening"; index: number };

export interface EditActions {
  /** Another plan, `goesOn` while the user drags; returns false if it is refused. */
  edit: (plan: PlanDocument, goesOn?: boolean) => boolean;
  select: (selection: Selection) => void;
}

const STEP_M = 0.05;
const FAR_STEP_M = 0.5;
const KINDS: Record<string, OpeningKind> = { d: "door", w: "window", p: "passage" };
const SNAP_UNITS = 1;

export class Handles {
  readonly element = s("g", { class: "handles" });
  private plan: PlanDocument = { rooms: [] };
  private unit = 0.1;

  constructor(
    private readonly svg: SVGSVGElement,
    private readonly actions: EditActions,
  ) {}

  /** Draw the handles of the selection and keep the focus. */
  draw(plan: PlanDocument, selection: Selection, unit: number): void {
    this.plan = plan;
    this.unit = unit;
    const room = selection.kind === "room" ? selection.index : -1;
    const shapes: SVGElement[] = plan.rooms.map(({ polygon }, index) => this.roomShape(polygon, index, index === room));
    plan.rooms.forEach((_, index) => index !== room && shapes.push(...this.wallShapes(index, false)));
    if (plan.rooms[room] !== undefined) shapes.push(...this.wallShapes(room, true), ...this.cornerShapes(room));
    (plan.openings ?? []).forEach((_, index) => shapes.push(...this.openingShapes(index, selection)));
    showKeepingFocus(this.element, ...shapes);
  }

  private roomShape(polygon: Point[], index: number, isSelected: boolean): SVGElement {
    const name = this.plan.rooms[index]!.name || `room ${index + 1}`;
    const select = (): void => this.actions.select({ kind: "room", index });
    return s("path", {
      d: path(polygon),
      class: `grab-room${isSelected ? " selected" : ""}`,
      id: `edit-room-${index}`,
      tabindex: 0,
      role: "button",
      "aria-label": `Room ${name}`,
      "aria-pressed": String(isSelected),
      onclick: select,
      onkeydown: (event) => {
        const key = (event as KeyboardEvent).key;
        if (key === "Enter" || key === " ") {
          event.preventDefault();
          select();
        }
        if (key === "Delete") {
          this.actions.select({ kind: "none" });
          this.actions.edit(change.removeRoom(this.plan, index), false);
        }
      },
    });
  }

  private cornerShapes(room: number): SVGElement[] {
    return this.plan.rooms[room]!.polygon.map(([x, y], corner) => {
      const move = (to: Point, goesOn: boolean): boolean =>
        this.actions.edit(change.moveCorner(this.plan, room, corner, to), goesOn);
      const handle = s("circle", {
        cx: x,
        cy: -y,
        r: 1.1 * this.unit,
        class: "corner",
        id: `edit-corner-${corner}`,
        tabindex: 0,
        role: "button",
        "aria-label": `Corner ${corner + 1}, x ${x.toFixed(2)}, y ${y.toFixed(2)} m. Arrow keys move it, Delete removes it.`,
        ondblclick: () => this.actions.edit(change.removeCorner(this.plan, room, corner), false),
        onkeydown: (event) =>
          this.onKey(event as KeyboardEvent, {
            move: (by) => move([x + by[0], y + by[1]], false),
            remove: () => this.actions.edit(change.removeCorner(this.plan, room, corner), false),
          }),
      });
      this.drag(handle, (to, goesOn) => {
        const here = this.plan.rooms[room]!.polygon[corner]!;
        return move(change.snapped(this.plan, to, SNAP_UNITS * this.unit, here), goesOn);
      });
      return handle;
    });
  }

  /** Draw the walls of a room for the pointer, and those of the selected one for the keyboard. */
  private wallShapes(room: number, isSelected: boolean): SVGElement[] {
    return this.plan.rooms[room]!.polygon.flatMap((_, edge) => {
      const wall = { room, edge },
        [[ax, ay], [bx, by]] = change.wallOf(this.plan, wall);
      const middle: Point = [0.5 * (ax + bx), 0.5 * (ay + by)];
      const split = (): boolean => this.actions.edit(change.splitWall(this.plan, wall, middle), false);
      const select = (): void => this.actions.select({ kind: "room", index: room });
      const keys = {
        id: `edit-wall-${edge}`,
        tabindex: 0,
        role: "button",
        "aria-label": `Wall ${edge + 1}, ${Math.hypot(bx - ax, by - ay).toFixed(2)} m. Arrow keys move it, Enter adds a corner; D, W and P add a door, a window or a passage.`,
        onkeydown: (event: Event): void => {
          const kind = KINDS[(event as KeyboardEvent).key.toLowerCase()];
          if (kind !== undefined) this.actions.edit(change.addOpening(this.plan, kind, wall, middle), false);
          else
            this.onKey(event as KeyboardEvent, {
              move: (by) => this.actions.edit(change.moveWall(this.plan, wall, by), false),
              split,
            });
        },
      };
      const line = s("line", {
        ...ends(change.wallOf(this.plan, wall)),
        class: "grab-wall",
        ondblclick: split,
        ...(isSelected ? keys : { onclick: select }),
      });
      let before = this.plan;
      this.drag(line, (to, goesOn, from) => {
        if (!goesOn) before = this.plan;
        if (!goesOn && !isSelected) select();
        return this.actions.edit(change.moveWall(before, wall, [to[0] - from[0], to[1] - from[1]]), goesOn);
      });
      if (!isSelected) return [line];
      const plus = s("circle", {
        cx: middle[0],
        cy: -middle[1],
        r: 0.7 * this.unit,
        class: "split",
        "aria-hidden": "true",
        onclick: split,
      });
      return [line, plus];
    });
  }

  private openingShapes(index: number, selection: Selection): SVGElement[] {
    const opening = this.plan.openings![index]!,
      [[ax, ay], [bx, by]] = opening.line;
    const isSelected = selection.kind === "opening" && selection.index === index;
    const slide = (to: Point, goesOn: boolean): boolean =>
      this.actions.edit(change.slideOpening(this.plan, index, to), goesOn);
    const select = (): void => {
      if (!isSelected) this.actions.select({ kind: "opening", index });
    };
    const line = s("line", {
      ...ends(opening.line),
      class: `grab-opening${isSelected ? " selected" : ""}`,
      id: `edit-opening-${index}`,
      tabindex: 0,
      role: "button",
      "aria-pressed": String(isSelected),
      "aria-label": `${opening.kind} ${index + 1}, ${change.widthOf(opening).toFixed(2)} m wide. Arrow keys slide it, Delete removes it.`,
      onclick: select,
      onkeydown: (event) =>
        this.onKey(event as KeyboardEvent, {
          move: (by_) => slide([0.5 * (ax + bx) + by_[0], 0.5 * (ay + by) + by_[1]], false),
          remove: () => {
            this.actions.select({ kind: "none" });
            this.actions.edit(change.removeOpening(this.plan, index), false);
          },
          split: select,
        }),
    });
    this.drag(line, (to, goesOn) => {
      if (!goesOn) select();
      return slide(to, goesOn);
    });
    if (!isSelected) return [line];
    const tips = opening.line.map(([x, y], end) => {
      const handle = s("circle", { cx: x, cy: -y, r: 0.9 * this.unit, class: "corner", "aria-hidden": "true" });
      this.drag(handle, (to, goesOn) =>
        this.actions.edit(change.stretchOpening(this.plan, index, end as 0 | 1, to), goesOn),
      );
      return handle;
    });
    return [line, ...tips];
  }

  /** Follow a pointer from its first movement on, even if the handle is redrawn; `to` returns false if it is refused. */
  private drag(handle: SVGElement, to: (place: Point, goesOn: boolean, from: Point) => boolean): void {
    handle.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      event.stopPropagation();
      (handle as SVGElement & { focus(): void }).focus();
      const begin = placeOf(this.svg, event);
      let goesOn = false;
      followPointer((moving) => {
        if (!goesOn && Math.hypot(moving.clientX - event.clientX, moving.clientY - event.clientY) < 3) return;
        goesOn = to(placeOf(this.svg, moving), goesOn, begin) || goesOn;
      });
    });
  }

  private onKey(
    event: KeyboardEvent,
    does: { move: (by: Point) => void; remove?: () => void; split?: () => void },
  ): void {
    const arrow = ARROWS[event.key],
      step = event.shiftKey ? FAR_STEP_M : STEP_M;
    if (arrow !== undefined) does.move([arrow[0] * step, arrow[1] * step]);
    else if (event.key === "Delete" && does.remove !== undefined) does.remove();
    else if (event.key === "Enter" && does.split !== undefined) does.split();
    else return;
    event.preventDefault();
  }
}
