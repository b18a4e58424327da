/** Form for facts that an uploaded file does not state: unit, scale, storey or page. */

import { api } from "./api";
import { button, byId, h, show } from "./dom";
import { InputError, showError } from "./notices";
import { PictureScale } from "./picture_scale";
import { labelOf } from "./plain_words";

const UNITS = ["m", "cm", "mm", "in", "ft"];
// Fields of the upload: name, label, placeholder.
const FIELDS: [string, string, string][] = [
  ["level", "Level", "name or number"],
  ["scale", "Scale on paper", "1:100"],
  ["metres_per_pixel", "Metres per pixel", "0.01"],
  ["multiply", "Factor of all lengths", "0.652"],
  ["crop", "Only this part", "x0,y0,x1,y1"],
  ["page", "Page of a PDF", "1"],
  ["layers", "Only these layers", "walls, doors"],
  ["ceiling_height_m", "Ceiling, m", "2.5"],
];
// The other fields do not apply to pictures.
const OF_PICTURES = ["metres_per_pixel", "scale", "multiply", "crop", "level", "ceiling_height_m"];
export const PICTURES = /^image\/(png|jpeg)$/;

// Endings of files that can be read, perhaps with other options.
const PLAN_FILES = /\.(dxf|dwg|svg|pdf|ifc|ifczip|zip|json|geojson|osm|xml|gml|ya?ml|pgm|png|jpe?g)$/i;

/** Return whether options can help to read a file: no option makes a plan of a text. */
export const hasOptions = (file: File): boolean => PLAN_FILES.test(file.name);

/** Refuse a picture with more pixels than the service reads, before the user measures it. */
export async function checkPixels(file: File): Promise<void> {
  const picture = new Image();
  picture.src = URL.createObjectURL(file);
  await new Promise((resolve) => {
    picture.onload = picture.onerror = resolve;
  });
  URL.revokeObjectURL(picture.src);
  // The browser can show fewer pictures than the service reads, and the limit is the service's to enforce.
  const { naturalWidth: width, naturalHeight: height } = picture;
  const limits = width > 0 ? await api.limits().catch(() => null) : null;
  if (limits === null || width * height <= limits.max_plan_pixels) return;
  const share = Math.floor(100 * Math.sqrt(limits.max_plan_pixels / (width * height)));
  throw new InputError(
    `“${file.name}” has ${width} × ${height} = ${width * height} pixels; the limit is ${limits.max_plan_pixels}. ` +
      `Make it smaller, to ${share} % of its width.`,
  );
}

export class ImportForm {
  private readonly inputs = new Map<string, HTMLInputElement | HTMLSelectElement>();
  private readonly picture = new PictureScale();
  private readonly isPlan = h("input", { type: "checkbox", id: "import-plan" });
  private file: File | null = null;

  /** `again` uploads the file with the values of the form, `all` uploads all of its levels, `cancelled` gives up. */
  constructor(
    private readonly again: (file: File, fields: Record<string, string>) => void,
    private readonly all: (file: File, fields: Record<string, string>) => void,
    private readonly cancelled: () => void,
  ) {
    this.inputs.set(
      "units",
      h("select", {}, h("option", { value: "" }, "from the file"), ...UNITS.map((unit) => h("option", {}, unit))),
    );
    for (const [name, , hint] of FIELDS)
      this.inputs.set(name, h("input", { type: "text", placeholder: hint, autocomplete: "off" }));
    this.picture.metres.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.send();
    });
  }

  /** Fields by name, for marking errors. */
  get fields(): Record<string, HTMLElement> {
    return { ...Object.fromEntries(this.inputs), known_distance: this.picture.metres, plan: this.isPlan };
  }

  /**
   * Show the form for a file, open if the file cannot be read without it; `levels` are those to choose from, of which
   * the largest was read if the form is not needed, and `factor` multiplies all lengths if the areas or dimensions
   * written in the file are right.
   */
  ask(file: File, isNeeded: boolean, levels: string[] = [], factor: number | null = null): void {
    const isPicture = PICTURES.test(file.type);
    if (isPicture && file !== this.file)
      void this.picture.open(file).catch((error: unknown) => showError(byId("plan-error"), error));
    this.file = file;
    const shown = [["units", "Unit"] as const, ...FIELDS]
      .filter(([name]) => !isPicture || OF_PICTURES.includes(name))
      .map(([name, label]) => {
        const input = this.inputs.get(name)!;
        input.id = `import-${name}`;
        return h("div", {}, h("label", { for: input.id }, label), input);
      });
    const heading =
      levels.length > 0
        ? `“${file.name}” has ${levels.length} levels: choose one, or import all`
        : !isNeeded
          ? `Import “${file.name}” again with other options`
          : isPicture
            ? `Set the scale of “${file.name}”`
            : `Import options for “${file.name}”`;
    const again = button(isPicture && isNeeded ? "Read the picture" : "Import again", () => this.send(), {
      id: "import-again",
      class: isNeeded ? "primary" : null,
    });
    const whole = button("Import all levels as a venue", () => this.sendAll(), {
      id: "import-levels",
      class: "primary",
    });
    const ask = h(
      "div",
      { class: "ask" },
      levels.length > 0 && whole,
      !(isNeeded && levels.length > 0) && again,
      factor !== null &&
        button(`Apply × ${factor.toFixed(3)} to all lengths`, () => this.multiply(factor), {
          id: "import-apply",
          class: "primary",
        }),
      button("Cancel", () => this.cancelled()),
    );
    const fields = h("div", { class: "fields" }, ...shown);
    const choices = levels.map((name) => button(name, () => this.sendLevel(name)));
    const items = choices.map((choice) => h("li", {}, choice));
    const list = levels.length > 0 ? [h("ul", { class: "levels", "aria-label": "Levels" }, ...items)] : [];
    show(
      byId("import-form"),
      h(
        "details",
        { open: isNeeded || factor !== null || levels.length > 0 },
        h("summary", {}, heading),
        ...list,
        ...(isNeeded && levels.length > 0
          ? [ask]
          : isPicture
            ? [
                this.picture.element,
                h("label", { class: "check" }, this.isPlan, ` ${labelOf("plan")}`),
                ask,
                h("details", {}, h("summary", {}, "Other ways to state the scale"), fields),
              ]
            : [fields, ask]),
      ),
    );
  }

  /** Close the form, by default whatever its file, and forget its values. */
  close(file = this.file): void {
    if (file !== this.file) return;
    this.file = null;
    this.picture.close();
    this.isPlan.checked = false;
    for (const input of this.inputs.values()) input.value = "";
    show(byId("import-form"));
  }

  /** Ask for the distance if a picture was refused for want of a scale; return whether it was. */
  askForScale(error: unknown): boolean {
    const isAsked =
      this.file !== null &&
      PICTURES.test(this.file.type) &&
      error instanceof Error &&
      error.message.includes("gives no scale");
    if (isAsked) this.picture.askForDistance();
    return isAsked;
  }

  /** Read the file again with all lengths multiplied, also those that were multiplied before. */
  private multiply(factor: number): void {
    const input = this.inputs.get("multiply")!;
    input.value = (factor * (Number(input.value) || 1)).toPrecision(6);
    this.send();
  }

  private sendLevel(level: string): void {
    this.inputs.get("level")!.value = level;
    this.send();
  }

  private sendAll(): void {
    if (this.file === null) return;
    const { level: _, ...fields } = this.values;
    this.all(this.file, fields);
  }

  /** Filled fields of the form that apply to its file. */
  private get values(): Record<string, string> {
    const isPicture = PICTURES.test(this.file?.type ?? ""),
      entries = [...this.inputs].map(([name, input]) => [name, input.value.trim()] as const),
      values = Object.fromEntries(entries.filter(([name]) => !isPicture || OF_PICTURES.includes(name)));
    if (isPicture) {
      values.known_distance = this.picture.knownDistance ?? "";
      values.crop = this.picture.part ?? values.crop!;
      values.plan = this.isPlan.checked ? "true" : "";
    }
    return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== ""));
  }

  private send(): void {
    if (this.file !== null) this.again(this.file, this.values);
  }
}
