/** Picture under the rooms to draw over, from the plan's origin to the right and up. */

import { s, show } from "../dom";

const FIRST_WIDTH_M = 12;

export class Underlay {
  readonly element = s("g", { class: "underlay" });
  private url: string | null = null;
  private size = { width: 0, height: 0 };
  private metresPerPixel = 0;

  get box(): { width: number; height: number } | null {
    return this.url === null ? null : { width: this.size.width * this.metresPerPixel, height: this.size.height * this.metresPerPixel };
  }

  /** Lay a picture under the plan, 12 m wide if its scale is unknown. Rejects if the file is not a picture. */
  async lay(file: Blob, name: string, metresPerPixel: number | null = null): Promise<void> {
    const url = URL.createObjectURL(file);
    const picture = new Image();
    picture.src = url;
    try {
      await picture.decode();
    } catch {
      URL.revokeObjectURL(url);
      throw new Error(`The browser cannot show “${name}” as a picture. Use a PNG or JPEG file.`);
    }
    this.remove();
    this.url = url;
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
    this.url = null;
    show(this.element);
  }

  private draw(): void {
    const box = this.box;
    if (box === null || this.url === null) return;
    show(this.element, s("image", { href: this.url, x: 0, y: -box.height, width: box.width, height: box.height, opacity: 0.55, preserveAspectRatio: "none" }));
  }
}
