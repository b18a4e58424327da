/** Visible part of a drawing: wheel and pinch zoom, dragging the background moves it. */

import { button, followPointer, h } from "./dom";
import type { Box } from "./plan_drawing";
import { placeOf } from "./pose_marker";
import type { Point } from "./types";

const MAX_ZOOM = 40;

export class Viewport {
  private whole: Box = { x: 0, y: 0, width: 1, height: 1 };
  /** The visible part. */
  current: Box = this.whole;

  /** `changed` is called when another part is visible. */
  constructor(
    private readonly svg: SVGSVGElement,
    place: HTMLElement,
    private readonly changed: () => void,
  ) {
    place.append(
      h(
        "div",
        { class: "zoom", role: "group", "aria-label": "Zoom" },
        button("+", () => this.zoom(0.7), { "aria-label": "Zoom in" }),
        button("−", () => this.zoom(1 / 0.7), { "aria-label": "Zoom out" }),
        button("▢", () => this.show(this.whole), { "aria-label": "Show the whole plan" }),
      ),
    );
    svg.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(event.deltaY > 0 ? 1.15 : 1 / 1.15, placeOf(svg, event));
      },
      { passive: false },
    );
    svg.addEventListener("pointerdown", (event) => this.onPointer(event));
  }

  /** Show a whole drawing. */
  fit(whole: Box): void {
    this.whole = whole;
    this.show(whole);
  }

  private show(box: Box): void {
    this.current = box;
    this.svg.setAttribute("viewBox", `${box.x} ${box.y} ${box.width} ${box.height}`);
    this.changed();
  }

  private zoom(
    factor: number,
    about: Point = [this.current.x + 0.5 * this.current.width, -this.current.y - 0.5 * this.current.height],
  ): void {
    const width = this.current.width * factor;
    if (width > 3 * this.whole.width || width < this.whole.width / MAX_ZOOM) return;
    const [x, y] = [about[0], -about[1]];
    this.show({
      x: x + (this.current.x - x) * factor,
      y: y + (this.current.y - y) * factor,
      width,
      height: this.current.height * factor,
    });
  }

  private onPointer(event: PointerEvent): void {
    // Handles stop this event, and tools prevent it.
    if (event.defaultPrevented || event.button !== 0) return;
    const from = placeOf(this.svg, event);
    followPointer((moving) => {
      const to = placeOf(this.svg, moving);
      this.show({ ...this.current, x: this.current.x - (to[0] - from[0]), y: this.current.y + (to[1] - from[1]) });
    });
  }
}
