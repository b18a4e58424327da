/** Hints of the place of a photograph: a circle on the plan, and rooms. */

import { ARROWS, byId, followPointer, h, s, show } from "./dom";
import { say } from "./notices";
import { type Box, unitOf } from "./plan_drawing";
import { placeOf } from "./pose_marker";
import type { Hints, Point } from "./types";

const DEFAULT_RADIUS_M = 3;
const STEP_M = 0.1;
const FAR_STEP_M = 1;

export const NO_HINTS: Hints = { near: null, radius: DEFAULT_RADIUS_M, rooms: [], strict: false };

/** Return hints as fields of a query. */
export function hintFields(hints: Hints): Record<string, string> {
  const fields: Record<string, string> = {};
  if (hints.near !== null) {
    const [x, y] = hints.near;
    fields.near = JSON.stringify({ x_m: Number(x.toFixed(3)), y_m: Number(y.toFixed(3)) });
    fields.radius_m = String(hints.radius);
  }
  if (hints.rooms.length > 0) fields.rooms = JSON.stringify(hints.rooms);
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
  private readonly strict = byId<HTMLInputElement>("hint-strict");
  private hints: Hints = NO_HINTS;
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
    this.strict.addEventListener("change", () => this.change({ strict: this.strict.checked }));
    // Capture runs before the viewport's listener, which would move the drawing.
    svg.addEventListener("pointerdown", (event) => this.onDown(event), { capture: true });
    addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.isMarking) this.setMarking(false);
    });
  }

  get fields(): Record<string, HTMLElement> {
    return { near: this.mark, radius_m: this.radius, rooms: this.rooms, strict: this.strict };
  }

  /** Offer the rooms of a plan. */
  setRooms(rooms: { id: string; name: string }[]): void {
    show(
      this.rooms,
      ...rooms.map(({ id, name }) => {
        const box = h("input", { type: "checkbox", value: id });
        box.addEventListener("change", () => this.change({ rooms: this.ticked() }));
        return h("label", { class: "inline" }, box, name);
      }),
    );
    byId("hint-rooms-box").hidden = rooms.length === 0;
    this.show(this.hints);
  }

  /** Show the hints of a photograph; null if there is none. */
  show(hints: Hints | null): void {
    this.hints = hints ?? NO_HINTS;
    if (document.activeElement !== this.radius)
      this.radius.value = Number.isNaN(this.hints.radius) ? "" : String(this.hints.radius);
    this.strict.checked = this.hints.strict;
    for (const box of this.rooms.querySelectorAll("input")) box.checked = this.hints.rooms.includes(box.value);
    byId("hint-unmark").hidden = this.hints.near === null;
    const { near, radius, rooms } = this.hints;
    byId("hints-summary").textContent = [
      near === null ? "" : `within ${Number.isNaN(radius) ? "?" : radius} m of the mark`,
      rooms.length === 0 ? "" : `in ${rooms.length === 1 ? "one room" : `${rooms.length} rooms`}`,
    ]
      .filter(Boolean)
      .join(", ");
    this.draw(this.box);
  }

  /** Redraw the circle for another visible part of the plan. */
  draw(box: Box): void {
    this.box = box;
    const { near, radius } = this.hints;
    const isFocused = this.element.contains(document.activeElement);
    show(
      this.element,
      near !== null && s("circle", { class: "reach", cx: near[0], cy: -near[1], r: Math.max(radius || 0, 0) }),
      near !== null && this.grip(near),
    );
    if (isFocused) this.element.querySelector<SVGElement>(".grip")?.focus();
  }

  private grip([x, y]: Point): SVGElement {
    const size = unitOf(this.box);
    return s("circle", {
      class: "grip",
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

  private ticked(): string[] {
    return [...this.rooms.querySelectorAll<HTMLInputElement>("input:checked")].map((box) => box.value);
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
      this.change({ near: [x + 0.5 * width, -y - 0.5 * height] });
    }
    say("Click the plan, or move the mark with the arrow keys.");
    this.element.querySelector<SVGElement>(".grip")?.focus({ preventScroll: true });
  }

  private onDown(event: PointerEvent): void {
    if (!this.isMarking || event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    this.change({ near: placeOf(this.svg, event) });
    this.setMarking(false);
  }

  private onDrag(event: PointerEvent): void {
    event.preventDefault();
    event.stopPropagation();
    followPointer((moving) => this.change({ near: placeOf(this.svg, moving) }));
  }

  private onKey(event: KeyboardEvent): void {
    const { near } = this.hints,
      arrow = ARROWS[event.key];
    if (near === null) return;
    if (event.key === "Delete") this.change({ near: null });
    else if (arrow !== undefined) {
      const step = event.shiftKey ? FAR_STEP_M : STEP_M;
      this.change({ near: [near[0] + step * arrow[0], near[1] + step * arrow[1]] });
    } else return;
    event.preventDefault();
  }
}
