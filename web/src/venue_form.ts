/** Form for a new venue: a name, and plans with their levels. */

import { api } from "./api";
import { button, byId, h, show } from "./dom";
import { attempt, InputError, say } from "./notices";
import { nameIn } from "./plan_caption";
import type { PlanSummary, Venue } from "./types";

interface Row {
  plan: PlanSummary;
  level: HTMLInputElement;
}

const MAX_NAME_LENGTH = 200;

export class VenueForm {
  private readonly error = h("div", { class: "error", id: "venue-error", role: "alert", hidden: true });
  private readonly name = h("input", {
    id: "venue-form-name",
    type: "text",
    maxlength: MAX_NAME_LENGTH,
    autocomplete: "off",
  });
  private readonly choice = h("select", { id: "venue-form-plan" });
  private readonly rows = h("ul", { "aria-label": "Plans of the new venue" });
  private readonly add = button("Add", () => this.take(), { id: "venue-form-add" });
  private listed: PlanSummary[] = [];
  private chosen: Row[] = [];

  /** `made` is called with the stored venue. */
  constructor(private readonly made: (venue: Venue) => void) {
    const label = h("label", { class: "sr", for: this.choice.id }, "Plan to add");
    show(
      byId("venue-form"),
      this.error,
      h("div", {}, h("label", { for: this.name.id }, "Name of the venue"), this.name),
      h("div", { class: "row" }, label, this.choice, this.add),
      this.rows,
      button("Create the venue", () => void this.send(), { class: "primary", id: "venue-form-make" }),
    );
  }

  /** Offer the listed plans. */
  offer(plans: PlanSummary[]): void {
    this.listed = plans;
    this.draw();
  }

  /** Add a plan, one level above the last one. */
  private take(): void {
    const plan = this.listed.find(({ id }) => id === this.choice.value);
    if (plan === undefined) return;
    const last = this.chosen.at(-1)?.level.valueAsNumber ?? -1;
    const level = h("input", {
      type: "number",
      step: "any",
      value: Number.isNaN(last) ? 0 : last + 1,
      "aria-label": `Level of ${plan.name}`,
    });
    this.chosen.push({ plan, level });
    this.draw();
  }

  private async send(): Promise<void> {
    const fields = Object.fromEntries([
      ["name", this.name] as const,
      ...this.chosen.map(({ level }, index) => [`plans.${index}.level`, level] as const),
    ]);
    const create = async (): Promise<void> => {
      const missing = this.chosen.find(({ level }) => Number.isNaN(level.valueAsNumber));
      if (this.name.value.trim() === "") throw new InputError("Enter a name for the venue.");
      if (this.chosen.length === 0) throw new InputError("Add at least one plan.");
      if (missing !== undefined)
        throw new InputError(`Enter the level of ${missing.plan.name} as a number: 0 is the ground floor.`);
      const plans = this.chosen.map(({ plan, level }) => ({ floorplan_id: plan.id, level: level.valueAsNumber }));
      const venue = await api.createVenue(this.name.value.trim(), plans);
      this.name.value = "";
      this.chosen = [];
      this.draw();
      say(`“${venue.name}” is stored.`);
      this.made(venue);
    };
    await attempt(this.error, create, fields);
  }

  private draw(): void {
    const left = this.listed.filter(({ id }) => !this.chosen.some(({ plan }) => plan.id === id));
    show(this.choice, ...left.map((plan) => h("option", { value: plan.id }, nameIn(plan, this.listed))));
    this.choice.disabled = this.add.disabled = left.length === 0;
    show(
      this.rows,
      ...this.chosen.map(({ plan, level }, index) =>
        h(
          "li",
          {},
          h("span", { class: "name" }, plan.name),
          h("span", { "aria-hidden": "true" }, "level"),
          level,
          button("×", () => this.remove(index), { class: "remove", "aria-label": `Remove ${plan.name}` }),
        ),
      ),
    );
  }

  private remove(index: number): void {
    this.chosen.splice(index, 1);
    this.draw();
  }
}
