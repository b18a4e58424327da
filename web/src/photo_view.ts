/** Photograph, full spheres in a viewer, with the lines of the layout over it. */

import { throughCamera } from "./camera";
import { ARROWS, button, h, show } from "./dom";
import { type LayoutLine, radians } from "./layout";
import { linesLegend, strokeLines } from "./layout_strokes";
import { InputError } from "./notices";
import { equirectangular, type Gaze, perspective, type Size } from "./projection";
import type { Point, ViewAnswer } from "./types";

type Sphere = import("./sphere").Sphere;
/** A full sphere from inside, the same as a flat picture, or another photograph. */
type Shape = "around" | "whole" | "flat";

const TURN_BY = radians(10);
// Photo sphere metadata stand before the pixels.
const METADATA_BYTES = 2 ** 18;
const END_OF_JPEG = new Uint8Array([0xff, 0xd9]);
// Pixels of the longer side of a saved photograph.
const SAVED_PIXELS = 2400;

export class PhotoView {
  private readonly canvas = h("canvas", { class: "overlay", "aria-hidden": "true" });
  private readonly stage = h("div", {
    class: "stage",
    tabindex: 0,
    role: "application",
    id: "stage",
    "aria-label": "Photograph; arrow keys turn, plus and minus zoom",
    "aria-describedby": "fit-state",
  });
  private readonly picture = h("img", { class: "whole", alt: "" });
  private readonly holder = h("div", { class: "sphere" });
  private readonly shapes: Record<"around" | "whole", HTMLButtonElement>;
  private readonly choices: HTMLElement;
  private sphere: Sphere | null = null;
  private shape: Shape = "around";
  private view: ViewAnswer | null = null;
  private url: string | null = null;
  /** Settles when the viewer has loaded its latest picture or failed to. */
  private loading: Promise<void> = Promise.resolve();
  private lines: LayoutLine[] = [];
  private heading = 0;
  private shown = true;

  /** `gazed` is called with the yaw from the picture's centre and the field of view, radians. */
  constructor(
    root: HTMLElement,
    private readonly gazed: (yaw: number, fov: number) => void,
  ) {
    this.shapes = {
      around: button("From inside", () => this.setShape("around"), { "aria-pressed": "true" }),
      whole: button("Whole picture", () => this.setShape("whole"), { "aria-pressed": "false" }),
    };
    const lines = h("input", { type: "checkbox", id: "lines-shown", checked: true });
    lines.addEventListener("change", () => {
      this.shown = lines.checked;
      this.draw();
    });
    this.choices = h(
      "div",
      { class: "segmented", role: "group", "aria-label": "View of the photograph" },
      this.shapes.around,
      this.shapes.whole,
    );
    const bar = h(
      "div",
      { class: "bar" },
      this.choices,
      h("label", { class: "inline" }, lines, "Layout"),
      button(
        "Full screen",
        () => void (document.fullscreenElement === null ? root.requestFullscreen() : document.exitFullscreen()),
        { id: "full-screen" },
      ),
      linesLegend(),
    );
    this.stage.append(this.holder, this.picture, this.canvas);
    show(root, this.stage, bar);
    this.stage.addEventListener("keydown", (event) => this.onKey(event));
    new ResizeObserver(() => this.draw()).observe(this.stage);
    this.picture.addEventListener("load", () => this.draw());
  }

  /** Show a photograph; null shows none. Rejects if the file is not a picture. */
  async setPicture(file: File | null): Promise<void> {
    const before = this.url;
    // The viewer has loaded it by then, or failed to.
    if (before !== null) void this.loading.catch(() => undefined).then(() => URL.revokeObjectURL(before));
    this.url = file === null ? null : URL.createObjectURL(ended(file));
    this.stage.className = file === null ? "stage empty" : "stage";
    this.stage.dataset.name = file?.name ?? "";
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
      throw new InputError(`The browser cannot show “${file!.name}” as a picture; the service may still read it.`);
    }
    const sphere = await isSphere(file!, this.picture);
    if (sphere === (this.shape === "flat")) this.shape = sphere ? "around" : "flat";
    await this.refresh();
  }

  /** Set the lines of the layout, with azimuths clockwise from the plan's +y, and the heading of the centre. */
  setLines(lines: LayoutLine[], headingDeg: number): void {
    this.lines = lines;
    this.heading = radians(headingDeg);
    this.draw();
  }

  /** Set what the service assumed about the photograph; null before an answer. */
  setView(view: ViewAnswer | null): void {
    this.view = view;
    // The service knows better than `isSphere`.
    const isPart = view !== null && view.hfov.source === "given" && view.hfov.value_deg < 360;
    const isFlat = view !== null && (view.camera !== null || view.projection === "cylindrical" || isPart);
    // A sphere whose orientation, on its side, the service ignored is shown as it is stored, by the style sheet.
    const isStored = view?.hfov.value_deg === 360 && this.picture.naturalHeight > this.picture.naturalWidth;
    if (isStored) this.stage.classList.add("stored");
    const shape = isStored ? "whole" : isFlat ? "flat" : this.shape;
    if (shape === this.shape) this.draw();
    else this.setShape(shape);
  }

  /** Draw the whole photograph with the layout; null if the browser cannot show it. */
  toCanvas(): HTMLCanvasElement | null {
    const { naturalWidth, naturalHeight } = this.picture;
    if (this.url === null || naturalWidth === 0 || this.stage.classList.contains("empty")) return null;
    const share = Math.min(1, SAVED_PIXELS / Math.max(naturalWidth, naturalHeight));
    const size: Size = { width: Math.round(share * naturalWidth), height: Math.round(share * naturalHeight) };
    if (this.stage.matches(".stored")) [size.width, size.height] = [size.height, size.width];
    const canvas = h("canvas", { width: size.width, height: size.height }),
      context = canvas.getContext("2d")!;
    context.drawImage(this.picture, 0, 0, size.width, size.height);
    const shape = this.shape === "flat" ? "flat" : "whole";
    if (this.shown) this.stroke(context, shape, size, Math.max(1, size.width / 800));
    return canvas;
  }

  private setShape(shape: Shape): void {
    this.shape = shape;
    void this.refresh();
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
    this.choices.hidden = this.shape === "flat";
    for (const [name, control] of Object.entries(this.shapes))
      control.setAttribute("aria-pressed", String(name === this.shape));
    this.draw();
  }

  private onKey(event: KeyboardEvent): void {
    if (this.sphere === null || this.shape !== "around") return;
    const zooms: Record<string, number> = { "+": 10, "=": 10, "-": -10 };
    const arrow = ARROWS[event.key],
      zoom = zooms[event.key];
    if (arrow !== undefined) this.sphere.turnBy(TURN_BY * arrow[0], TURN_BY * arrow[1]);
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
    this.gazed(gaze.yaw, this.fieldOfView(gaze, size));
    if (!this.shown) return;
    context.scale(sharp, sharp);
    if (this.shape === "flat") {
      const { width, height } = this.flatSize(size);
      context.translate(0.5 * (size.width - width), 0.5 * (size.height - height));
    }
    this.stroke(context, this.shape, size);
  }

  /** Stroke the lines of the layout, `scale` times as thick as on the screen. */
  private stroke(context: CanvasRenderingContext2D, shape: Shape, size: Size, scale = 1): void {
    const seen = this.lines.map((line) => ({ kind: line.kind, pieces: this.projected(line, shape, size) }));
    strokeLines(context, seen, scale);
  }

  private projected(line: LayoutLine, shape: Shape, size: Size): Point[][] {
    const relative = line.points.map(([azimuth, elevation]): Point => [azimuth - this.heading, elevation]);
    if (shape === "flat") return this.view === null ? [] : throughCamera(relative, this.view, this.flatSize(size));
    return shape === "around" ? perspective(relative, this.gaze(), size) : equirectangular(relative, size);
  }

  /** Return the size of a flat photograph, which the stage contains. */
  private flatSize(stage: Size): Size {
    const { naturalWidth: width, naturalHeight: height } = this.picture;
    const share = Math.min(stage.width / Math.max(width, 1), stage.height / Math.max(height, 1));
    return { width: share * width, height: share * height };
  }

  private fieldOfView(gaze: Gaze, size: Size): number {
    if (this.shape === "flat") return this.view === null ? 1 : radians(this.view.hfov.value_deg);
    if (this.shape === "whole") return 2 * Math.PI;
    return 2 * Math.atan(Math.tan(0.5 * gaze.verticalFov) * (size.width / Math.max(size.height, 1)));
  }

  private gaze(): Gaze {
    return this.shape === "around" && this.sphere !== null ? this.sphere.gaze() : { yaw: 0, pitch: 0, verticalFov: 1 };
  }
}

/** Return a JPEG file with the marker of its end, so that one whose last bytes are lost is decoded as far as it goes. */
function ended(file: Blob): Blob {
  return file.type === "image/jpeg" ? new Blob([file, END_OF_JPEG], { type: file.type }) : file;
}

/** Guess whether a photograph is a full sphere, or a part that its metadata place on one. */
async function isSphere(file: Blob, { naturalWidth, naturalHeight }: HTMLImageElement): Promise<boolean> {
  if (Math.abs(naturalWidth / naturalHeight - 2) <= 0.02) return true;
  const head = await file.slice(0, METADATA_BYTES).text();
  return head.includes("GPano:") && head.includes("equirectangular");
}
