/** Dial over the photograph that shows and sets the azimuth of its centre in the plan. */

import { ARROWS, byId } from "./dom";
import { degrees } from "./layout";

export class Compass {
  private readonly element = byId("compass-place");
  private readonly dial = byId<SVGSVGElement>("compass");
  private readonly needle = this.dial.querySelector(".needle")!;
  private readonly north = this.dial.querySelector(".to-north")!;
  private readonly text = this.element.querySelector(".dial-text")!;
  /** Heading in the form; null if unknown. */
  private heading: number | null = null;
  /** Heading of the answer, which is shown while none is given. */
  private found: number | null = null;

  constructor(private readonly turned: (headingDeg: number | null) => void) {
    this.dial.addEventListener("pointerdown", (event) => this.onPointer(event));
    this.dial.addEventListener("pointermove", (event) => {
      if (event.buttons > 0) this.onPointer(event);
    });
    this.dial.addEventListener("keydown", (event) => this.onKey(event));
    this.set(null);
    this.setNorth(null);
  }

  /** Show a given heading; null means unknown. */
  set(headingDeg: number | null): void {
    this.heading = headingDeg;
    this.draw();
  }

  /** Show the heading of an answer while none is given; null means no answer. */
  setFound(headingDeg: number | null): void {
    this.found = headingDeg;
    this.draw();
  }

  private draw(): void {
    const shown = this.heading ?? this.found,
      isFound = this.heading === null && shown !== null;
    this.element.classList.toggle("unknown", shown === null);
    this.element.classList.toggle("found", isFound);
    this.needle.setAttribute("transform", `rotate(${shown ?? 0})`);
    const text = shown === null ? "unknown" : `${isFound ? "found " : ""}${Math.round(shown) % 360}°`;
    this.dial.setAttribute("aria-valuenow", String(Math.round(shown ?? 0)));
    this.dial.setAttribute("aria-valuetext", text);
    this.text.textContent = text;
  }

  /** Show the direction of north on the plan; null means unknown. */
  setNorth(northDeg: number | null): void {
    this.north.toggleAttribute("hidden", northDeg === null);
    this.north.setAttribute("transform", `rotate(${northDeg ?? 0})`);
  }

  private turn(headingDeg: number | null): void {
    this.set(headingDeg === null ? null : (headingDeg + 360) % 360);
    this.turned(this.heading);
  }

  private onPointer(event: PointerEvent): void {
    event.preventDefault();
    this.dial.focus();
    this.dial.setPointerCapture(event.pointerId);
    const box = this.dial.getBoundingClientRect();
    const x = event.clientX - box.x - 0.5 * box.width,
      y = event.clientY - box.y - 0.5 * box.height;
    if (Math.hypot(x, y) > 2) this.turn(Math.round(degrees(Math.atan2(x, -y))));
  }

  private onKey(event: KeyboardEvent): void {
    const pages: Record<string, number> = { PageUp: 10, PageDown: -10 };
    const arrow = ARROWS[event.key],
      step = arrow ? arrow[0] + arrow[1] : pages[event.key];
    if (step !== undefined) this.turn(Math.round(this.heading ?? this.found ?? -step) + step);
    else if (event.key === "Home") this.turn(0);
    else if (event.key === "Delete" || event.key === "Escape") this.turn(null);
    else return;
    event.preventDefault();
  }
}
