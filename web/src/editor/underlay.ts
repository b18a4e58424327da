/** Picture that shows through the rooms, to draw over and to check them, from the plan's origin to the right and up. */

import { h, s, show } from "../dom";
import { loadPicture } from "../pictures";

const FIRST_WIDTH_M = 12;
const FIRST_SHARE = 0.6;

/** A picture and its place below a plan; without a scale it is 12 m wide. */
export interface Traced {
  file: Blob;
  name: string;
  metresPerPixel?: number;
  /** Clockwise rotation about its centre. */
  turnedDeg?: number;
}

export class Underlay {
  readonly element = s("g", { class: "underlay" });
  private url: string | null = null;
  private size = { width: 0, height: 0 };
  private metresPerPixel = 0;
  private laid: Traced | null = null;
  /** Form for the share of the picture that shows through the rooms. */
  readonly slider = h("input", { type: "range", min: 0, max: 1, step: 0.05, value: FIRST_SHARE, id: "see-through" });

  constructor(private readonly svg: SVGSVGElement) {
    this.slider.addEventListener("input", () => this.mix());
  }

  get box(): { width: number; height: number } | null {
    return this.url === null
      ? null
      : { width: this.size.width * this.metresPerPixel, height: this.size.height * this.metresPerPixel };
  }

  /** The picture as it lies, to lay it again. */
  get traced(): Traced | null {
    return this.laid && { ...this.laid, metresPerPixel: this.metresPerPixel };
  }

  /** Lay a picture under the plan. Rejects if the file is not a picture. */
  async lay(traced: Traced): Promise<void> {
    const { file, name, metresPerPixel } = traced;
    const picture = await loadPicture(file, `The browser cannot show “${name}” as a picture. Use a PNG or JPEG file.`);
    this.remove();
    this.url = picture.src;
    this.laid = traced;
    this.size = { width: picture.naturalWidth, height: picture.naturalHeight };
    this.metresPerPixel = metresPerPixel ?? FIRST_WIDTH_M / picture.naturalWidth;
    this.draw();
  }

  scale(factor: number): void {
    this.metresPerPixel *= factor;
    this.draw();
  }

  remove(): void {
    if (this.url !== null) URL.revokeObjectURL(this.url);
    this.url = this.laid = null;
    show(this.element);
    this.mix();
  }

  /** Make the rooms as transparent as the slider says, if there is a picture. */
  private mix(): void {
    this.svg.classList.toggle("traced", this.url !== null);
    this.svg.style.setProperty("--cover", String(1 - this.slider.valueAsNumber));
  }

  private draw(): void {
    const box = this.box;
    if (box === null || this.url === null) return;
    show(
      this.element,
      s("image", {
        href: this.url,
        x: 0,
        y: -box.height,
        width: box.width,
        height: box.height,
        preserveAspectRatio: "none",
        transform: `rotate(${this.laid?.turnedDeg ?? 0} ${0.5 * box.width} ${-0.5 * box.height})`,
      }),
    );
    this.mix();
  }
}
