/** What to say of a file that does not say it itself: its unit, scale, storey or page. */

import { button, byId, h, show } from "./dom";
import { showError } from "./notices";
import { PictureScale } from "./picture_scale";

const UNITS = ["m", "cm", "mm", "in", "ft"];
// Fields of the upload, with what people call them.
const FIELDS: [string, string, string][] = [
  ["level", "Storey", "name or number"],
  ["scale", "Scale on paper", "1:100"],
  ["metres_per_pixel", "Metres per pixel", "0.01"],
  ["page", "Page of a PDF", "1"],
  ["layers", "Only these layers", "walls, doors"],
  ["ceiling_height_m", "Ceiling, m", "2.5"],
];
// The others say nothing of a picture.
const OF_PICTURES = ["metres_per_pixel", "scale", "ceiling_height_m"];
const LONGEST_NAME = 200;
const PICTURES = /^image\/(png|jpeg)$/;

export class ImportForm {
  private readonly inputs = new Map<string, HTMLInputElement | HTMLSelectElement>();
  private readonly picture = new PictureScale();
  private file: File | null = null;

  /** `again` uploads the file with what was said of it. */
  constructor(private readonly again: (file: File, fields: Record<string, string>) => void) {
    this.inputs.set("units", h("select", {}, h("option", { value: "" }, "as in the file"), ...UNITS.map((unit) => h("option", {}, unit))));
    for (const [name, , hint] of FIELDS) this.inputs.set(name, h("input", { type: "text", placeholder: hint, autocomplete: "off" }));
    this.picture.metres.addEventListener("keydown", (event) => { if (event.key === "Enter") this.send(); });
  }

  /** The fields at fault are marked in these. */
  get fields(): Record<string, HTMLElement> {
    return { ...Object.fromEntries(this.inputs), known_distance: this.picture.metres };
  }

  /** Ask about a file: what it has to be told to be read, or what one may want to correct of how it was. */
  ask(file: File, isNeeded: boolean): void {
    const isPicture = PICTURES.test(file.type);
    if (isPicture && file !== this.file) {
      void this.picture.open(file).catch((error: unknown) => showError(byId("plan-error"), error));
    }
    this.file = file;
    const labels: [string, string][] = [["units", "Unit"], ...FIELDS.map(([name, label]): [string, string] => [name, label])];
    const asked = labels.filter(([name]) => !isPicture || OF_PICTURES.includes(name)).map(([name, label]) => {
      const input = this.inputs.get(name)!;
      input.id = `import-${name}`;
      return h("div", {}, h("label", { for: input.id }, label), input);
    });
    const heading = !isNeeded ? `Read “${file.name}” again, with more said of it` :
      isPicture ? `How large is “${file.name}”?` : `What “${file.name}” does not say of itself`;
    show(byId("import-form"), h("details", { open: isNeeded }, h("summary", {}, heading),
      isPicture && this.picture.element,
      h("div", { class: "fields" }, isPicture && h("p", { class: "hint" }, "Or instead, and what else is known:"), ...asked),
      h("div", { class: "ask" },
        button(isPicture && isNeeded ? "Read the picture" : "Read it again", () => this.send(), { id: "import-again", class: isNeeded ? "primary" : null }),
        button("Cancel", () => this.close()))));
  }

  /** Ask about nothing; what was said of the last file says nothing of the next. */
  close(): void {
    this.file = null;
    this.picture.close();
    for (const input of this.inputs.values()) input.value = "";
    show(byId("import-form"));
  }

  private send(): void {
    if (this.file === null) return;
    const isPicture = PICTURES.test(this.file.type);
    const said = Object.fromEntries([...this.inputs].filter(([name]) => !isPicture || OF_PICTURES.includes(name))
      .map(([name, input]): [string, string] => [name, input.value.trim()]).filter(([, value]) => value !== ""));
    const distance = this.picture.knownDistance;
    if (isPicture && distance !== null) said.known_distance = distance;
    // Nothing else names what a picture shows.
    if (isPicture) said.name = this.file.name.replace(/\.[^.]*$/, "").slice(0, LONGEST_NAME) || this.file.name;
    if (isPicture && distance === null && said.metres_per_pixel === undefined && said.scale === undefined) {
      showError(byId("plan-error"), new Error("A picture does not say how large it is: put the line’s ends on two points, and say how many metres apart they are."));
      this.picture.metres.setAttribute("aria-invalid", "true");
      this.picture.metres.focus();
      return;
    }
    this.again(this.file, said);
  }
}
