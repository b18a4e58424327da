/** Picture that shows through the rooms, to draw over and to check them, from the plan's origin to the right and up. */

import { api } from "../api";
import { h, s, show } from "../dom";
import { loadPicture } from "../pictures";
import type { Plan } from "../types";

const FIRST_WIDTH_M = 12;
const FIRST_SHARE = 0.6;
// Note of reports without the angle, by which earlier versions turned the picture.
const TURNED = /\bturned by\b/;
const MAX_KEPT = 4;

/** A picture and its place below a plan; without a scale it is 12 m wide. */
export interface Traced {
  file: Blob;
  name: string;
  metresPerPixel?: number;
  /** Clockwise rotation about its centre. */
  turnedDeg?: number;
}

/** Pictures that lie below plans again without being asked for. */
export class TracedPictures {
  /** The latest pictures below plans that were stored on this page, by the ids of the plans. */
  private readonly kept = new Map<string, Traced>();

  /** Keep the picture below a plan that is stored. */
  keep(planId: string, traced: Traced | null): void {
    if (traced === null) return;
    this.kept.delete(planId);
    this.kept.set(planId, traced);
    for (const oldest of [...this.kept.keys()].slice(0, -MAX_KEPT)) this.kept.delete(oldest);
  }

  /** Return the picture that a plan was drawn over or read from; null if there is none, or its angle is unknown. */
  async of(plan: Plan): Promise<Traced | null> {
    const kept = this.kept.get(plan.id),
      report = plan.import_report;
    if (kept !== undefined) return kept;
    if (report?.format !== "picture") return null;
    const { metres_per_unit: metresPerPixel, turned_deg: turnedDeg } = report;
    if (turnedDeg === 0 && report.notes.some((note) => TURNED.test(note))) return null;
    return { file: await api.original(plan.id), name: plan.name, metresPerPixel, turnedDeg };
  }
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
