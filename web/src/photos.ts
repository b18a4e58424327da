/** Photographs with their settings and answers. */

import { Compass } from "./compass";
import { button, byId, h, show } from "./dom";
import { acceptChoice, acceptDrops, inOrder, isPicture } from "./drops";
import { NO_HINTS } from "./hints";
import { clearErrors, InputError, showError } from "./notices";
import type { Answer, Hints } from "./types";

export interface Photo {
  file: File;
  /** The photograph came with an example, not from the user. */
  isExample: boolean;
  url: string;
  /** Filled fields of the form, by their names in the request. */
  settings: Record<string, string>;
  hints: Hints;
  answer: Answer | null;
  /** Direction of a frame of a guided turn, degrees clockwise from its first, by a gyroscope. */
  direction: number | null;
  /** Fields and photographs of the latest query, for code snippets. */
  asked: { fields: Record<string, string>; files: File[]; onDevice: boolean };
}

// Fields of the form by their names in the request.
const SETTINGS = {
  heading_deg: "heading",
  heading_tolerance_deg: "tolerance",
  camera_height_m: "camera-height",
  hfov_deg: "field-of-view",
  projection: "projection",
  pitch_deg: "pitch",
  roll_deg: "roll",
} as const;
type Setting = keyof typeof SETTINGS;
const NAMES = Object.keys(SETTINGS) as Setting[];

/** Form of the chosen photograph, and the strip of all photographs. */
export class Photos {
  readonly compass: Compass;
  private readonly strip = byId("photo-strip");
  private readonly error = byId("photo-error");
  private readonly inputs = Object.fromEntries(
    NAMES.map((name) => [name, byId<HTMLInputElement | HTMLSelectElement>(SETTINGS[name])]),
  ) as Record<Setting, HTMLInputElement | HTMLSelectElement>;
  private readonly choice = byId<HTMLFieldSetElement>("together");
  private readonly isTurn = this.choice.querySelector<HTMLInputElement>("input[value=turn]")!;
  private readonly all: Photo[] = [];
  /** The chosen photograph. */
  current: Photo | null = null;

  /** `changed` is called when another photograph is chosen or its settings change. */
  constructor(private readonly changed: (photo: Photo | null, isOther: boolean) => void) {
    this.compass = new Compass((degrees) => {
      this.inputs.heading_deg.value = degrees === null ? "" : String(degrees);
      this.read();
    });
    for (const field of Object.values(this.inputs)) field.addEventListener("input", () => this.read());
    this.choice.addEventListener("change", () => this.onMotion());
    acceptChoice(byId("photo-file"), async (files) => this.add(await inOrder(files)));
    acceptDrops(byId("photo-panel"), async (files) => this.add(await inOrder(files)));
  }

  get list(): readonly Photo[] {
    return this.all;
  }

  get fields(): Record<string, HTMLElement> {
    return { ...this.inputs, headings_deg: this.inputs.heading_deg };
  }

  /** All photographs, if they are to be localised together as a turn; null if each is localised by itself. */
  get group(): readonly Photo[] | null {
    return !this.choice.hidden && this.isTurn.checked ? this.all : null;
  }

  /** Add pictures and choose the first of them; those of an example give way to others. */
  add(files: File[], isExample = false, directions: readonly number[] | null = null, isTurn = false): void {
    const rejected = files.filter((file) => !isPicture(file));
    clearErrors();
    const added = files
      .filter(isPicture)
      .map((file, index): Photo => ({
        file,
        isExample,
        url: URL.createObjectURL(file),
        settings: { ...this.shared },
        hints: NO_HINTS,
        answer: null,
        direction: directions?.[index] ?? null,
        asked: { fields: {}, files: [file], onDevice: false },
      }));
    if (added[0] !== undefined) {
      this.forgetGroup();
      const examples = this.all.filter((photo) => photo.isExample);
      this.discard(examples);
      // Photographs of an example and the user's own are no turn together.
      if (isTurn || examples.length > 0) this.setTurn(isTurn && this.all.length === 0);
      this.all.push(...added);
      this.choose(added[0]);
    }
    if (rejected.length === 0) return;
    const names = rejected.map((file) => `“${file.name}”`).join(", ");
    const limits = "must be JPEG, PNG, WebP or HEIC files, neither empty nor hidden.";
    showError(this.error, new InputError(`${names}: photographs ${limits}`));
  }

  /** Take the frames of a guided turn instead of all photographs. */
  takeTurn(frames: File[], directions: readonly number[] | null): void {
    this.discard(this.all);
    this.add(frames, false, directions, true);
  }

  /** Add the photographs of an example, unless they are there, and choose the first of them. */
  addExample(files: File[], isTurn: boolean): void {
    const shown = this.all.find(({ file }) => file.name === files[0]?.name);
    if (shown === undefined) this.add(files, true, null, isTurn);
    else this.choose(shown);
  }

  private setTurn(isTurn: boolean): void {
    this.choice.querySelector<HTMLInputElement>(`input[value="${isTurn ? "turn" : ""}"]`)!.checked = true;
  }

  private discard(photos: readonly Photo[]): void {
    for (const photo of [...photos]) {
      this.all.splice(this.all.indexOf(photo), 1);
      URL.revokeObjectURL(photo.url);
    }
  }

  choose(photo: Photo | null): void {
    this.current = photo;
    for (const name of NAMES) this.inputs[name].value = photo?.settings[name] ?? "";
    this.showHeading();
    byId("photo-settings").toggleAttribute("disabled", photo === null);
    this.drawStrip();
    this.changed(photo, true);
  }

  /** Remove all answers, which belong to one plan. */
  forgetAnswers(): void {
    for (const photo of this.all) photo.answer = null;
    this.drawStrip();
  }

  forgetHints(): void {
    for (const photo of this.all) photo.hints = NO_HINTS;
  }

  setHints(hints: Hints): void {
    if (this.current === null) return;
    this.current.hints = hints;
    this.onChanged(this.current);
  }

  private remove(photo: Photo): void {
    const index = this.all.indexOf(photo);
    this.discard([photo]);
    this.forgetGroup();
    if (photo === this.current) this.choose(this.all[Math.min(index, this.all.length - 1)] ?? null);
    else {
      this.drawStrip();
      this.changed(this.current, false);
    }
  }

  /** Show the heading in the form on the compass. */
  private showHeading(): void {
    const heading = this.current?.settings.heading_deg;
    this.compass.set(heading === undefined ? null : Number(heading));
  }

  /** Settings that all photographs of a group share: those of the camera. */
  private get shared(): Photo["settings"] {
    if (this.group === null || this.current === null) return {};
    const { heading_deg: _, ...shared } = this.current.settings;
    return shared;
  }

  private read(): void {
    if (this.current === null) return;
    const given = NAMES.map((name) => [name, this.inputs[name].value.trim()] as const).filter(
      ([, value]) => value !== "",
    );
    this.current.settings = Object.fromEntries(given);
    this.share();
    this.showHeading();
    this.onChanged(this.current);
  }

  private share(): void {
    if (this.group === null) return;
    const shared = this.shared;
    for (const photo of this.all) {
      const { heading_deg } = photo.settings;
      photo.settings = heading_deg === undefined ? shared : { ...shared, heading_deg };
    }
  }

  private onMotion(): void {
    this.share();
    this.forgetGroup();
    this.drawStrip();
    if (this.current !== null) this.onChanged(this.current);
  }

  private onChanged(photo: Photo): void {
    this.forgetGroup();
    photo.answer = null;
    this.drawStrip();
    this.changed(photo, false);
  }

  /** Remove the answers of photographs that were localised together. */
  private forgetGroup(): void {
    for (const photo of this.all) if (photo.answer?.together !== undefined) photo.answer = null;
  }

  drawStrip(): void {
    this.choice.hidden = this.all.length < 2;
    const group = this.group;
    byId("find-all").hidden = this.all.length < 2 || group !== null;
    show(
      this.strip,
      ...this.all.map((photo) => {
        const name = photo.file.name.replace(/^example-/, "");
        const choose = h(
          "button",
          {
            type: "button",
            class: "thumb",
            "aria-pressed": String(photo === this.current),
            "aria-label": `Photograph ${name}${photo.answer === null ? "" : `, found in ${photo.answer.room}`}`,
            onclick: () => this.choose(photo),
          },
          h("img", { src: photo.url, alt: "", onerror: (event) => (event.target as Element).remove() }),
          h("span", {}, photo.answer === null ? name : `✓ ${photo.answer.room}`),
        );
        const remove = button("×", () => this.remove(photo), { class: "remove", "aria-label": `Remove ${name}` });
        return h("li", {}, choose, remove);
      }),
    );
  }
}
