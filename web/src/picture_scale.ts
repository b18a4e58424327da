/** Scale of a picture: two points and the distance between them. */

import { ARROWS, followPointer, h, s, show, showKeepingFocus } from "./dom";
import { ends, unitOf } from "./plan_drawing";
import { clearError, showFieldError } from "./notices";
import { loadPicture } from "./pictures";
import { placeOf } from "./pose_marker";
import type { Point } from "./types";
import { Viewport } from "./viewport";

const FAR_STEPS = 20;

export class PictureScale {
  readonly element: HTMLElement;
  readonly metres = h("input", {
    type: "number",
    min: 0.01,
    step: "any",
    id: "picture-metres",
    placeholder: "4.2",
    inputmode: "decimal",
  });
  private readonly framing = h("input", { type: "checkbox", id: "picture-frame" });
  private readonly error = h("p", { class: "field-error", id: "picture-metres-error", role: "alert", hidden: true });
  private readonly svg = s("svg", {
    class: "picture",
    role: "group",
    "aria-label": "The picture with the two ends of a known distance",
  });
  private readonly picture = s("g");
  private readonly overlay = s("g", { class: "measured" });
  private readonly viewport: Viewport;
  private url: string | null = null;
  // As on a plan, y points up: points below the picture's upper edge have a negative y.
  private ends: [Point, Point] = [
    [0, 0],
    [0, 0],
  ];

  /** Two opposite corners of the part that is read; null for the whole picture. */
  private frame: [Point, Point] | null = null;

  constructor() {
    const drawing = h("div", { class: "drawing" }, this.svg);
    this.element = h(
      "div",
      { class: "picture-scale" },
      h(
        "p",
        { class: "hint" },
        "Put both ends of the line on points with a known distance, such as the ends of a dimensioned wall. " +
          "Without a distance, the dimensions written in the picture are used, else the usual sizes of doors and " +
          "stairs. If the picture shows several storeys, drag a frame around one.",
      ),
      h("label", { class: "check" }, this.framing, " Drag a frame around the part to read"),
      drawing,
      h("div", {}, h("label", { for: this.metres.id }, "Distance of the ends in metres"), this.metres, this.error),
    );
    this.metres.addEventListener("input", () => clearError(this.error, { metres: this.metres }));
    this.svg.append(this.picture, this.overlay);
    this.framing.addEventListener("change", () => {
      if (!this.framing.checked) this.frame = null;
      this.draw();
    });
    // Capture runs before the viewport's listener, which would move the drawing.
    this.svg.addEventListener("pointerdown", (event) => this.onDown(event));
    this.viewport = new Viewport(this.svg, drawing, () => this.draw());
  }

  /** Show a picture. Rejects if the file is not one. */
  async open(file: File): Promise<void> {
    this.close();
    const picture = await loadPicture(file, `The browser cannot show “${file.name}” as a picture.`);
    const { src, naturalWidth: width, naturalHeight: height } = picture;
    this.url = src;
    show(this.picture, s("image", { href: src, x: 0, y: 0, width, height }));
    this.ends = [
      [0.25 * width, -0.5 * height],
      [0.75 * width, -0.5 * height],
    ];
    this.viewport.fit({ x: 0, y: 0, width, height });
  }

  close(): void {
    if (this.url !== null) URL.revokeObjectURL(this.url);
    this.url = null;
    this.metres.value = "";
    this.framing.checked = false;
    this.frame = null;
    clearError(this.error, { metres: this.metres });
    show(this.picture);
    show(this.overlay);
  }

  /** `x0,y0,x1,y1,metres` in pixels from the upper left corner; null without the distance. */
  get knownDistance(): string | null {
    if (this.url === null || this.metres.value.trim() === "") return null;
    return [...this.ends.flatMap(([x, y]) => [x.toFixed(1), (-y).toFixed(1)]), this.metres.value.trim()].join(",");
  }

  /** `x0,y0,x1,y1` of the framed part in pixels from the upper left corner; null for the whole picture. */
  get part(): string | null {
    if (this.url === null || this.frame === null) return null;
    return this.frame.flatMap(([x, y]) => [x.toFixed(0), (-y).toFixed(0)]).join(",");
  }

  /** Ask for the distance that is missing. */
  askForDistance(): void {
    showFieldError(
      this.error,
      this.metres,
      "The picture states no scale: put the ends of the line on two points and enter their distance in metres.",
    );
  }

  private draw(): void {
    if (this.url === null) return;
    const size = unitOf(this.viewport.current);
    showKeepingFocus(
      this.overlay,
      this.frame !== null && this.frameBox(this.frame),
      s("line", ends(this.ends)),
      ...this.ends.map((end, index) => this.handle(end, index, size)),
    );
  }

  private frameBox([[ax, ay], [bx, by]]: [Point, Point]): SVGElement {
    const [x, y] = [Math.min(ax, bx), Math.min(-ay, -by)];
    return s("rect", { x, y, width: Math.abs(bx - ax), height: Math.abs(by - ay), class: "frame" });
  }

  private handle([x, y]: Point, index: number, size: number): SVGElement {
    return s("circle", {
      cx: x,
      cy: -y,
      r: 1.3 * size,
      class: "corner",
      id: `picture-end-${index}`,
      tabindex: 0,
      role: "button",
      "aria-label": `${index === 0 ? "First" : "Second"} end of the line, at pixel ${x.toFixed(0)}, ${(-y).toFixed(0)}; arrow keys move it`,
      onkeydown: (event) => {
        const key = event as KeyboardEvent,
          arrow = ARROWS[key.key];
        if (arrow === undefined) return;
        event.preventDefault();
        const steps = key.shiftKey ? FAR_STEPS : 1;
        this.put(index, [x + steps * arrow[0], y + steps * arrow[1]]);
      },
    });
  }

  private put(index: number, place: Point): void {
    this.ends[index] = place;
    this.draw();
  }

  /** Drag the nearer end of the line; far from both, the viewport moves the picture. */
  private onDown(event: PointerEvent): void {
    if (event.button !== 0) return;
    const place = placeOf(this.svg, event);
    if (this.framing.checked) {
      event.preventDefault();
      event.stopImmediatePropagation();
      followPointer((moving) => {
        this.frame = [place, placeOf(this.svg, moving)];
        this.draw();
      });
      return;
    }
    const reach = 4 * unitOf(this.viewport.current);
    const distances = this.ends.map(([x, y]) => Math.hypot(x - place[0], y - place[1]));
    const index = distances[0]! <= distances[1]! ? 0 : 1;
    if (distances[index]! > reach) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    followPointer((moving) => this.put(index, placeOf(this.svg, moving)));
  }
}
