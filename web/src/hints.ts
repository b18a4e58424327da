/** Hints of the place of a photograph: a circle on the plan, rooms and, in a venue, a level. */

import { ARROWS, byId, followPointer, h, s, show, showKeepingFocus } from "./dom";
import { type Anchor, anchorOf, toEarth, toPlan } from "./earth";
import { say } from "./notices";
import { type Box, unitOf } from "./plan_drawing";
import { placeOf } from "./pose_marker";
import type { ChosenVenue, Hints, Plan, PlanDocument, Point } from "./types";

const DEFAULT_RADIUS_M = 3;
const STEP_M = 0.1;
const FAR_STEP_M = 1;

export const NO_HINTS: Hints = { near: null, radius: DEFAULT_RADIUS_M, rooms: [], level: null, strict: false };

/** Return hints as fields of a query. */
export function hintFields(hints: Hints): Record<string, string> {
  const fields: Record<string, string> = {};
  if (hints.near !== null) {
    fields.near = JSON.stringify(hints.near);
    fields.radius_m = String(hints.radius);
  }
  if (hints.rooms.length > 0) fields.rooms = JSON.stringify(hints.rooms);
  if (hints.level !== null) fields.level = String(hints.level);
  if (hints.strict) fields.strict = "true";
  return fields;
}

export class HintForm {
  /** The circle on the plan. */
  readonly element = s("g", { class: "hint-circle" });
  private readonly panel = byId<HTMLDetailsElement>("hints");
  private readonly mark = byId<HTMLButtonElement>("hint-mark");
  private readonly radius = byId<HTMLInputElement>("hint-radius");
  private readonly rooms = byId("hint-rooms");
  private readonly level = byId<HTMLInputElement>("hint-level");
  private readonly strict = byId<HTMLInputElement>("hint-strict");
  private hints: Hints = NO_HINTS;
  /** Rooms of the plan shown: their names by their values in a query. */
  private offered = new Map<string, string>();
  /** Frame of marks in a venue; "plan" outside of venues, null in a plan whose place on Earth is unknown. */
  private frame: Anchor | "plan" | null = "plan";
  private box: Box = { x: 0, y: 0, width: 1, height: 1 };
  private isMarking = false;

  /** `changed` is called when the user changes the hints. */
  constructor(
    private readonly svg: SVGSVGElement,
    private readonly changed: (hints: Hints) => void,
  ) {
    this.mark.addEventListener("click", () => this.setMarking(!this.isMarking));
    byId("hint-unmark").addEventListener("click", () => this.change({ near: null }));
    this.radius.addEventListener("input", () => this.change({ radius: this.radius.valueAsNumber }));
    this.level.addEventListener("input", () => {
      this.change({ level: this.level.value === "" ? null : this.level.valueAsNumber });
    });
    this.strict.addEventListener("change", () => this.change({ strict: this.strict.checked }));
    // Capture runs before the viewport's listener, which would move the drawing.
    svg.addEventListener("pointerdown", (event) => this.onDown(event), { capture: true });
    addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.isMarking) this.setMarking(false);
    });
  }

  get fields(): Record<string, HTMLElement> {
    return { near: this.mark, radius_m: this.radius, rooms: this.rooms, level: this.level, strict: this.strict };
  }

  /** Offer the hints that a query about a plan can have, or about a venue with this plan. */
  offer(plan: Plan | null, document: PlanDocument | null, venue: ChosenVenue | null): void {
    const rooms = plan?.rooms ?? document?.rooms.map(({ name }) => ({ id: name ?? "", name: name ?? "" })) ?? [];
    // Ids are unique in one plan, names select the rooms of all plans.
    const named = rooms.map(({ id, name }, index): [string, string] => [
      venue === null ? id : name || id,
      name || `room ${index + 1}`,
    ]);
    this.offered = new Map(named);
    this.frame = venue === null ? "plan" : document && anchorOf(document, venue);
    this.mark.disabled = this.frame === null;
    byId("hint-unplaced").hidden = document === null || this.frame !== null;
    for (const id of ["hint-level-box", "hint-rooms-venue"]) byId(id).hidden = venue === null;
    const levels = new Set(venue?.listed.map(({ level }) => level));
    show(byId("hint-levels"), ...[...levels].map((level) => h("option", { value: level })));
    this.drawRooms();
    this.show(this.hints);
  }

  /** Draw the rooms, with those of other plans of the venue that are ticked. */
  private drawRooms(): void {
    const rooms = new Map([
      ...this.offered,
      ...this.hints.rooms.map((room) => [room, this.offered.get(room) ?? room] as const),
    ]);
    show(
      this.rooms,
      ...[...rooms].map(([value, name]) => {
        const box = h("input", { type: "checkbox", value });
        box.addEventListener("change", () => this.change({ rooms: this.ticked() }));
        return h("label", { class: "inline" }, box, name);
      }),
    );
    byId("hint-rooms-box").hidden = rooms.size === 0;
  }

  /** Show the hints of a photograph; null if there is none. */
  show(hints: Hints | null): void {
    this.hints = hints ?? NO_HINTS;
    if (document.activeElement !== this.radius)
      this.radius.value = Number.isNaN(this.hints.radius) ? "" : String(this.hints.radius);
    this.strict.checked = this.hints.strict;
    const { near, radius, rooms, level } = this.hints;
    if (document.activeElement !== this.level) this.level.value = level === null ? "" : String(level);
    if (!rooms.every((room) => this.boxes.some(({ value }) => value === room))) this.drawRooms();
    for (const box of this.boxes) box.checked = rooms.includes(box.value);
    byId("hint-unmark").hidden = near === null;
    byId("hints-summary").textContent = [
      near === null ? "" : `within ${Number.isNaN(radius) ? "?" : radius} m of the mark`,
      rooms.length === 0 ? "" : `in ${rooms.length === 1 ? "one room" : `${rooms.length} rooms`}`,
      level === null ? "" : `on level ${level}`,
    ]
      .filter(Boolean)
      .join(", ");
    this.draw(this.box);
  }

  /** Redraw the circle for another visible part of the plan. */
  draw(box: Box): void {
    this.box = box;
    const { radius } = this.hints;
    const near = this.place;
    showKeepingFocus(
      this.element,
      near !== null && s("circle", { class: "reach", cx: near[0], cy: -near[1], r: Math.max(radius || 0, 0) }),
      near !== null && this.grip(near),
    );
  }

  private grip([x, y]: Point): SVGElement {
    const size = unitOf(this.box);
    return s("circle", {
      class: "grip",
      id: "hint-grip",
      cx: x,
      cy: -y,
      r: 1.2 * size,
      tabindex: 0,
      role: "button",
      "aria-label": `Mark at x ${x.toFixed(1)} m, y ${y.toFixed(1)} m; arrow keys move it, Delete removes it`,
      onpointerdown: (event) => this.onDrag(event as PointerEvent),
      onkeydown: (event) => this.onKey(event as KeyboardEvent),
    });
  }

  private get boxes(): HTMLInputElement[] {
    return [...this.rooms.querySelectorAll("input")];
  }

  private ticked(): string[] {
    return this.boxes.filter((box) => box.checked).map((box) => box.value);
  }

  /** Place of the mark on the plan shown; null without a mark, and in a plan whose place on Earth is unknown. */
  private get place(): Point | null {
    const { near } = this.hints;
    if (near === null || this.frame === null) return null;
    if ("x_m" in near) return [near.x_m, near.y_m];
    return this.frame === "plan" ? null : toPlan(this.frame, near);
  }

  private setPlace(place: Point): void {
    if (this.frame === null) return;
    const rounded = (value: number, digits: number): number => Number(value.toFixed(digits));
    if (this.frame === "plan") this.change({ near: { x_m: rounded(place[0], 3), y_m: rounded(place[1], 3) } });
    else {
      const { latitude, longitude } = toEarth(this.frame, place);
      this.change({ near: { latitude: rounded(latitude, 9), longitude: rounded(longitude, 9) } });
    }
  }

  private change(values: Partial<Hints>): void {
    this.show({ ...this.hints, ...values });
    this.changed(this.hints);
  }

  private setMarking(isMarking: boolean): void {
    this.isMarking = isMarking;
    this.mark.setAttribute("aria-pressed", String(isMarking));
    this.svg.classList.toggle("pointing", isMarking);
    if (!isMarking) return;
    this.panel.open = true;
    if (this.hints.near === null) {
      // Centre of the visible part, for users without a pointer.
      const { x, y, width, height } = this.box;
      this.setPlace([x + 0.5 * width, -y - 0.5 * height]);
    }
    say("Click the plan, or move the mark with the arrow keys.");
    this.element.querySelector<SVGElement>(".grip")?.focus({ preventScroll: true });
  }

  private onDown(event: PointerEvent): void {
    if (!this.isMarking || event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    this.setPlace(placeOf(this.svg, event));
    this.setMarking(false);
  }

  private onDrag(event: PointerEvent): void {
    event.preventDefault();
    event.stopPropagation();
    followPointer((moving) => this.setPlace(placeOf(this.svg, moving)));
  }

  private onKey(event: KeyboardEvent): void {
    const { place } = this;
    const arrow = ARROWS[event.key];
    if (place === null) return;
    if (event.key === "Delete") this.change({ near: null });
    else if (arrow !== undefined) {
      const step = event.shiftKey ? FAR_STEP_M : STEP_M;
      this.setPlace([place[0] + step * arrow[0], place[1] + step * arrow[1]]);
    } else return;
    event.preventDefault();
  }
}
