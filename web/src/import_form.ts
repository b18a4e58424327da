/** What to say of a file that does not say it itself: its unit, scale, storey or page; asked for when it is refused. */

import { button, byId, h, show } from "./dom";

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

export class ImportForm {
  private readonly inputs = new Map<string, HTMLInputElement | HTMLSelectElement>();
  private file: File | null = null;

  /** `again` uploads the file once more, with what was said of it. */
  constructor(private readonly again: (file: File, fields: Record<string, string>) => void) {
    this.inputs.set("units", h("select", {}, h("option", { value: "" }, "as in the file"), ...UNITS.map((unit) => h("option", {}, unit))));
    for (const [name, , hint] of FIELDS) this.inputs.set(name, h("input", { type: "text", placeholder: hint, autocomplete: "off" }));
  }

  /** The fields at fault are marked in these. */
  get fields(): Record<string, HTMLElement> {
    return Object.fromEntries(this.inputs);
  }

  /** Ask about a file that was refused, or understood in a way that one may want to correct. */
  ask(file: File): void {
    this.file = file;
    const labels: [string, string][] = [["units", "Unit"], ...FIELDS.map(([name, label]): [string, string] => [name, label])];
    show(byId("import-form"), h("p", { class: "hint" }, `What “${file.name}” does not say of itself:`),
      ...labels.map(([name, label]) => {
        const input = this.inputs.get(name)!;
        input.id = `import-${name}`;
        return h("div", {}, h("label", { for: input.id }, label), input);
      }), button("Read it again", () => this.send(), { id: "import-again" }));
  }

  /** Ask about nothing; what was said of the last file says nothing of the next. */
  close(): void {
    this.file = null;
    for (const input of this.inputs.values()) input.value = "";
    show(byId("import-form"));
  }

  private send(): void {
    const said = [...this.inputs].map(([name, input]): [string, string] => [name, input.value.trim()]).filter(([, value]) => value !== "");
    if (this.file !== null) this.again(this.file, Object.fromEntries(said));
  }
}
