/** How large a picture is: two of its points, and how far apart they really are. */

import { h, s, show } from "./dom";
import { unitOf } from "./plan_drawing";
import { placeOf } from "./pose_marker";
import type { Point } from "./types";
import { Viewport } from "./viewport";

const ARROWS: Record<string, Point> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const FAR_STEPS = 20;

export class PictureScale {
  readonly element: HTMLElement;
  readonly metres = h("input", { type: "number", min: 0.01, step: "any", id: "picture-metres", placeholder: "4.2", inputmode: "decimal" });
  private readonly svg = s("svg", { class: "picture", role: "group", "aria-label": "The picture with the two ends of a known distance" });
  private readonly picture = s("g");
  private readonly over = s("g", { class: "measured" });
  private readonly viewport: Viewport;
  private url: string | null = null;
  // As on a plan: y up, so that below the picture's upper edge it is negative.
  private ends: [Point, Point] = [[0, 0], [0, 0]];

  constructor() {
    const drawing = h("div", { class: "drawing" }, this.svg);
    this.element = h("div", { class: "picture-scale" },
      h("p", { class: "hint" }, "Put both ends of the line on points whose distance you know, such as a wall with its measure."), drawing,
      h("div", {}, h("label", { for: this.metres.id }, "These ends are so many metres apart"), this.metres));
    this.svg.append(this.picture, this.over);
    // Before the viewport, which would move what is seen.
    this.svg.addEventListener("pointerdown", (event) => this.onDown(event));
    this.viewport = new Viewport(this.svg, drawing, () => this.draw());
  }

  /** Show a picture; one that is there already stays as it is. Refused where the file is no picture. */
  async open(file: File): Promise<void> {
    this.close();
    const url = URL.createObjectURL(file);
    const picture = new Image();
    picture.src = url;
    try {
      await picture.decode();
    } catch {
      URL.revokeObjectURL(url);
      throw new Error(`“${file.name}” cannot be shown as a picture.`);
    }
    this.url = url;
    const width = picture.naturalWidth, height = picture.naturalHeight;
    show(this.picture, s("image", { href: url, x: 0, y: 0, width, height }));
    this.ends = [[0.25 * width, -0.5 * height], [0.75 * width, -0.5 * height]];
    this.viewport.fit({ x: 0, y: 0, width, height });
  }

  close(): void {
    if (this.url !== null) URL.revokeObjectURL(this.url);
    this.url = null;
    this.metres.value = "";
    show(this.picture);
    show(this.over);
  }

  /** `x0,y0,x1,y1,metres` in pixels from the upper left corner; null while the metres are not said. */
  get knownDistance(): string | null {
    if (this.url === null || this.metres.value.trim() === "") return null;
    return [...this.ends.flatMap(([x, y]) => [x.toFixed(1), (-y).toFixed(1)]), this.metres.value.trim()].join(",");
  }

  private draw(): void {
    if (this.url === null) return;
    const size = unitOf(this.viewport.current), [[ax, ay], [bx, by]] = this.ends;
    const focused = [...this.over.children].indexOf(document.activeElement as Element);
    show(this.over, s("line", { x1: ax, y1: -ay, x2: bx, y2: -by }), ...this.ends.map((end, index) => this.handle(end, index, size)));
    if (focused > 0) (this.over.children[focused] as SVGElement).focus();
  }

  private handle([x, y]: Point, index: number, size: number): SVGElement {
    return s("circle", {
      cx: x, cy: -y, r: 1.3 * size, class: "corner", tabindex: 0, role: "button",
      "aria-label": `${index === 0 ? "First" : "Second"} end of the line, at pixel ${x.toFixed(0)}, ${(-y).toFixed(0)}; arrow keys move it`,
      onkeydown: (event) => {
        const key = event as KeyboardEvent, arrow = ARROWS[key.key];
        if (arrow === undefined) return;
        event.preventDefault();
        const far = key.shiftKey ? FAR_STEPS : 1;
        this.put(index, [x + far * arrow[0], y + far * arrow[1]]);
      },
    });
  }

  private put(index: number, place: Point): void {
    this.ends[index] = place;
    this.draw();
  }

  /** Whichever end is nearer comes along; the background is moved where neither is near. */
  private onDown(event: PointerEvent): void {
    if (event.button !== 0) return;
    const place = placeOf(this.svg, event), reach = 4 * unitOf(this.viewport.current);
    const apart = this.ends.map(([x, y]) => Math.hypot(x - place[0], y - place[1]));
    const index = apart[0]! <= apart[1]! ? 0 : 1;
    if (apart[index]! > reach) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    const move = (moving: PointerEvent): void => this.put(index, placeOf(this.svg, moving));
    const end = (): void => {
      removeEventListener("pointermove", move);
      removeEventListener("pointerup", end);
      removeEventListener("pointercancel", end);
    };
    addEventListener("pointermove", move);
    addEventListener("pointerup", end);
    addEventListener("pointercancel", end);
  }
}

