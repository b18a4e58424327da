/** Photographs with their settings and answers. */

import { Compass } from "./compass";
import { byId, h, show } from "./dom";
import { NO_HINTS } from "./hints";
import { clearError, showError } from "./notices";
import type { Answer, Hints } from "./types";

export interface Photo {
  file: File;
  url: string;
  heading: number | null;
  tolerance: number;
  cameraHeight: number | null;
  hints: Hints;
  answer: Answer | null;
  /** Fields of the query, for code snippets. */
  fields: Record<string, string>;
}

const PICTURES = /^image\/(jpeg|png|webp)$/;

/** Form of the chosen photograph, and the strip of all photographs. */
export class Photos {
  readonly compass: Compass;
  private readonly strip = byId("photo-strip");
  private readonly error = byId("photo-error");
  private readonly heading = byId<HTMLInputElement>("heading");
  private readonly tolerance = byId<HTMLInputElement>("tolerance");
  private readonly height = byId<HTMLInputElement>("camera-height");
  private readonly all: Photo[] = [];
  private chosen: Photo | null = null;

  /** `changed` is called when another photograph is chosen or its settings change. */
  constructor(private readonly changed: (photo: Photo | null, isOther: boolean) => void) {
    this.compass = new Compass((degrees) => {
      this.heading.value = degrees === null ? "" : String(degrees);
      this.read();
    });
    byId("compass-place").append(this.compass.element);
    for (const field of [this.heading, this.tolerance, this.height]) field.addEventListener("input", () => this.read());
    const input = byId<HTMLInputElement>("photo-file");
    input.addEventListener("change", () => {
      this.add([...(input.files ?? [])]);
      input.value = "";
    });
    acceptDrops(byId("photo-panel"), (files) => this.add(files));
  }

  get current(): Photo | null {
    return this.chosen;
  }

  get list(): readonly Photo[] {
    return this.all;
  }

  get fields(): Record<string, HTMLElement> {
    return { heading_deg: this.heading, heading_tolerance_deg: this.tolerance, camera_height_m: this.height };
  }

  /** Add pictures and choose the first of them. */
  add(files: File[], headings: (number | null)[] = []): void {
    const rejected = files.filter((file) => !PICTURES.test(file.type));
    clearError(this.error);
    if (rejected.length > 0) {
      const names = rejected.map((file) => `“${file.name}”`).join(", ");
      showError(this.error, new Error(`${names}: photographs must be JPEG, PNG or WebP files, full 360° and twice as wide as high.`));
    }
    const added = files.filter((file) => PICTURES.test(file.type)).map((file, index): Photo => ({
      file, url: URL.createObjectURL(file), heading: headings[index] ?? null, tolerance: 0, cameraHeight: null, hints: NO_HINTS,
      answer: null, fields: {},
    }));
    this.all.push(...added);
    if (added[0] !== undefined) this.choose(added[0]);
  }

  /** Choose a photograph, or none. */
  choose(photo: Photo | null): void {
    this.chosen = photo;
    this.heading.value = photo?.heading === null || photo === null ? "" : String(photo.heading);
    this.tolerance.value = photo === null || photo.tolerance === 0 ? "" : String(photo.tolerance);
    this.height.value = photo?.cameraHeight === null || photo === null ? "" : String(photo.cameraHeight);
    this.compass.set(photo?.heading ?? null);
    byId("photo-settings").toggleAttribute("disabled", photo === null);
    this.drawStrip();
    this.changed(photo, true);
  }

  /** Remove all answers, which belong to one plan. */
  forgetAnswers(): void {
    for (const photo of this.all) photo.answer = null;
    this.drawStrip();
  }

  /** Remove all hints. */
  forgetHints(): void {
    for (const photo of this.all) photo.hints = NO_HINTS;
  }

  /** Set the hints of the chosen photograph. */
  setHints(hints: Hints): void {
    if (this.chosen === null) return;
    this.chosen.hints = hints;
    this.changed(this.chosen, false);
  }

  private remove(photo: Photo): void {
    const index = this.all.indexOf(photo);
    this.all.splice(index, 1);
    URL.revokeObjectURL(photo.url);
    if (photo === this.chosen) this.choose(this.all[Math.min(index, this.all.length - 1)] ?? null);
    else this.drawStrip();
  }

  private read(): void {
    if (this.chosen === null) return;
    const number = (field: HTMLInputElement): number | null => (field.value.trim() === "" ? null : field.valueAsNumber);
    this.chosen.heading = number(this.heading);
    this.chosen.tolerance = number(this.tolerance) ?? 0;
    this.chosen.cameraHeight = number(this.height);
    this.compass.set(this.chosen.heading);
    this.changed(this.chosen, false);
  }

  drawStrip(): void {
    byId("find-all").hidden = this.all.length < 2;
    show(this.strip, ...this.all.map((photo) => {
      const name = photo.file.name.replace(/^example-/, "");
      const choose = h("button", {
        type: "button", class: "thumb", "aria-pressed": String(photo === this.chosen),
        "aria-label": `Photograph ${name}${photo.answer === null ? "" : `, found in ${photo.answer.room}`}`,
        onclick: () => this.choose(photo),
      }, h("img", { src: photo.url, alt: "" }), h("span", {}, photo.answer === null ? name : `✓ ${photo.answer.room}`));
      const remove = h("button", { type: "button", class: "remove", "aria-label": `Remove ${name}`, onclick: () => this.remove(photo) }, "×");
      return h("li", {}, choose, remove);
    }));
  }
}

/** Accept files dropped on an element. */
export function acceptDrops(target: HTMLElement, take: (files: File[]) => void): void {
  for (const name of ["dragenter", "dragover"]) {
    target.addEventListener(name, (event) => {
      if (!(event as DragEvent).dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      target.classList.add("dropping");
    });
  }
  target.addEventListener("dragleave", (event) => {
    if (!target.contains((event as DragEvent).relatedTarget as Node | null)) target.classList.remove("dropping");
  });
  target.addEventListener("drop", (event) => {
    event.preventDefault();
    target.classList.remove("dropping");
    take([...((event as DragEvent).dataTransfer?.files ?? [])]);
  });
}
