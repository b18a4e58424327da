/** Photograph, in a panorama viewer or flat, with the lines of the layout over it. */

import { button, h, show } from "./dom";
import { type LayoutLine, radians } from "./layout";
import { equirectangular, type Gaze, perspective, type Size } from "./projection";
import type { OpeningKind, Point } from "./types";

type Sphere = import("./sphere").Sphere;
type Shape = "around" | "whole";

// Colours by Okabe and Ito, distinct for every kind of colour vision; dashes differ as well.
const STROKES: Record<"edge" | OpeningKind, { colour: string; dash: number[]; name: string }> = {
  edge: { colour: "#ffe14d", dash: [], name: "walls" },
  door: { colour: "#56b4e9", dash: [10, 4], name: "doors" },
  window: { colour: "#ff9d5c", dash: [3, 3], name: "windows" },
  passage: { colour: "#ffffff", dash: [12, 4, 3, 4], name: "passages" },
};
const TURN_BY = radians(10);

export class PanoramaView {
  private readonly canvas = h("canvas", { class: "overlay", "aria-hidden": "true" });
  private readonly stage = h("div", {
    class: "stage", tabindex: 0, role: "application", id: "stage",
    "aria-label": "Photograph; arrow keys turn, plus and minus zoom", "aria-describedby": "fit-state",
  });
  private readonly picture = h("img", { class: "whole", alt: "" });
  private readonly holder = h("div", { class: "sphere" });
  private readonly shapes: Record<Shape, HTMLButtonElement>;
  private sphere: Sphere | null = null;
  private shape: Shape = "around";
  private url: string | null = null;
  /** Settles when the viewer has loaded its latest picture or failed to. */
  private loading: Promise<void> = Promise.resolve();
  private lines: LayoutLine[] = [];
  private heading = 0;
  private shown = true;

  /** `gazed` is called with the yaw from the picture's centre and the field of view, radians. */
  constructor(root: HTMLElement, private readonly gazed: (yaw: number, fov: number) => void) {
    this.shapes = {
      around: button("Look around", () => this.setShape("around"), { "aria-pressed": "true" }),
      whole: button("Whole picture", () => this.setShape("whole"), { "aria-pressed": "false" }),
    };
    const lines = h("input", { type: "checkbox", id: "lines-shown", checked: true });
    lines.addEventListener("change", () => { this.shown = lines.checked; this.draw(); });
    const bar = h("div", { class: "bar" },
      h("div", { class: "segmented", role: "group", "aria-label": "View of the photograph" },
        this.shapes.around, this.shapes.whole),
      h("label", { class: "inline" }, lines, "Layout"),
      legend());
    this.stage.append(this.holder, this.picture, this.canvas);
    show(root, this.stage, bar);
    this.stage.addEventListener("keydown", (event) => this.onKey(event));
    new ResizeObserver(() => this.draw()).observe(this.stage);
    this.picture.addEventListener("load", () => this.draw());
  }

  /** Show a photograph; null shows none. Rejects if the file is not a picture. */
  async setPicture(file: Blob | null): Promise<void> {
    this.release(this.url);
    this.url = file === null ? null : URL.createObjectURL(file);
    this.stage.classList.toggle("empty", file === null);
    if (this.url === null) {
      this.picture.removeAttribute("src");
      this.setLines([], 0);
      return;
    }
    this.picture.src = this.url;
    try {
      await this.picture.decode();
    } catch {
      this.stage.classList.add("empty");
      throw new Error("The browser cannot show this file as a picture.");
    }
    await this.refresh();
  }

  /** Set the lines of the layout, with azimuths clockwise from the plan's +y, and the heading of the centre. */
  setLines(lines: LayoutLine[], headingDeg: number): void {
    this.lines = lines;
    this.heading = radians(headingDeg);
    this.draw();
  }

  private setShape(shape: Shape): void {
    this.shape = shape;
    void this.refresh();
  }

  /** Release a picture's memory after the viewer has loaded it. */
  private release(url: string | null): void {
    if (url === null) return;
    void this.loading.catch(() => undefined).then(() => URL.revokeObjectURL(url));
  }

  private async refresh(): Promise<void> {
    if (this.shape === "around" && this.url !== null) {
      const url = this.url;
      try {
        // The viewer is large, so it is loaded with the first picture.
        const { Sphere } = await import("./sphere");
        // A picture that was chosen in the meantime is shown by its own call.
        if (this.url !== url) return;
        this.sphere ??= new Sphere(this.holder, () => this.draw());
        this.loading = this.sphere.show(url);
        await this.loading;
      } catch (error) {
        // Without WebGL the viewer is missing, and the flat picture is shown.
        if (this.url !== url) return;
        this.shape = "whole";
        this.shapes.around.disabled = true;
        this.shapes.around.title = error instanceof Error ? error.message : "requires WebGL";
      }
    }
    this.stage.dataset.shape = this.shape;
    for (const [name, control] of Object.entries(this.shapes)) control.setAttribute("aria-pressed", String(name === this.shape));
    this.draw();
  }

  private onKey(event: KeyboardEvent): void {
    if (this.sphere === null || this.shape !== "around") return;
    const turns: Record<string, Point> = {
      ArrowLeft: [-TURN_BY, 0], ArrowRight: [TURN_BY, 0], ArrowUp: [0, TURN_BY], ArrowDown: [0, -TURN_BY],
    };
    const zooms: Record<string, number> = { "+": 10, "=": 10, "-": -10 };
    const turn = turns[event.key], zoom = zooms[event.key];
    if (turn !== undefined) this.sphere.turnBy(...turn);
    else if (zoom !== undefined) this.sphere.zoomBy(zoom);
    else return;
    event.preventDefault();
  }

  private draw(): void {
    const size: Size = { width: this.stage.clientWidth, height: this.stage.clientHeight };
    const sharp = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(size.width * sharp);
    this.canvas.height = Math.round(size.height * sharp);
    const context = this.canvas.getContext("2d");
    if (context === null || this.url === null) return;
    const gaze = this.gaze();
    this.gazed(gaze.yaw, this.shape === "whole" ? 2 * Math.PI : 2 * Math.atan(Math.tan(0.5 * gaze.verticalFov) *
      (size.width / Math.max(size.height, 1))));
    if (!this.shown) return;
    context.scale(sharp, sharp);
    context.lineJoin = context.lineCap = "round";
    const paths = this.lines.map((line) => ({ line, paths: this.projected(line, gaze, size) }));
    for (const halo of [true, false]) {
      for (const { line, paths: pieces } of paths) {
        const { colour, dash } = STROKES[line.kind];
        context.strokeStyle = halo ? "rgba(0, 0, 0, 0.55)" : colour;
        context.lineWidth = halo ? 5 : 2.5;
        context.setLineDash(halo ? [] : dash);
        for (const piece of pieces) {
          context.beginPath();
          piece.forEach(([x, y], index) => (index === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
          context.stroke();
        }
      }
    }
  }

  private projected(line: LayoutLine, gaze: Gaze, size: Size): Point[][] {
    const relative = line.points.map(([azimuth, elevation]): Point => [azimuth - this.heading, elevation]);
    return this.shape === "around" ? perspective([relative], gaze, size) : equirectangular([relative], size);
  }

  private gaze(): Gaze {
    return this.shape === "around" && this.sphere !== null ? this.sphere.gaze() : { yaw: 0, pitch: 0, verticalFov: 1 };
  }
}

function legend(): HTMLElement {
  return h("ul", { class: "legend", "aria-label": "Lines over the photograph" },
    ...Object.entries(STROKES).map(([kind, { name }]) => h("li", {}, h("span", { class: `swatch ${kind}` }), name)));
}
