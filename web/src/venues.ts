/** Venues: groups of plans that are searched together. */

import { api } from "./api";
import { byId, h, planButton, show } from "./dom";
import { attempt, showError } from "./notices";
import { storedAs } from "./plan_caption";
import type { ChosenVenue, PlanSummary, Venue } from "./types";
import { VenueForm } from "./venue_form";

export interface VenueActions {
  /** A venue was chosen, or null: none any more. */
  chosen: (venue: ChosenVenue | null) => void;
  /** One of the venue's plans is to be shown. */
  showPlan: (planId: string) => void;
}

// Words for levels in names of plans, such as those that an import made of a file's levels.
const NAMES_LEVEL =
  /(?<!\p{L})(level|floor|stor(e?y|ies)|basement|attic|ground|(erd|ober|unter|dach|keller)?gescho(ss|ß)|ebene|stock|étage|sous-sol|rez-de-chaussée|piano|piso|planta|andar|verdieping|våning|etasje|etage|piętro|parter|[eoudk]g)(?!\p{L})|階/iu;

/** Return name and level of a plan of a venue; a name that tells its level tells it once. */
export const planLabel = ({ name, level }: { name: string; level: number }): string =>
  NAMES_LEVEL.test(name) ? name : `${name}, level ${level}`;

export class Venues {
  private readonly list = byId("venue-list");
  private readonly bar = byId("venue-bar");
  private readonly choice = byId<HTMLSelectElement>("venue-plan");
  private readonly error = byId("plan-error");
  private readonly form = new VenueForm((venue) => void this.take(venue));
  private found: Venue[] = [];
  /** The venue that is searched. */
  current: ChosenVenue | null = null;

  constructor(private readonly actions: VenueActions) {
    this.choice.addEventListener("change", () => actions.showPlan(this.choice.value));
    byId("venue-leave").addEventListener("click", () => this.leave());
  }

  /** Offer the listed plans for a new venue. */
  offer(plans: PlanSummary[]): void {
    byId("venue-make").hidden = plans.length === 0;
    this.form.offer(plans);
  }

  /** List and choose a new venue. */
  async take(venue: { id: string }): Promise<void> {
    for (const fold of ["venue-make", "plan-menu"]) byId<HTMLDetailsElement>(fold).open = false;
    await Promise.all([this.load(""), this.choose(venue.id)]);
  }

  private pick(id: string): void {
    byId<HTMLDetailsElement>("plan-menu").open = false;
    void this.choose(id);
  }

  /** Load the list of venues with a name. */
  async load(name: string): Promise<void> {
    try {
      this.found = (await api.venues(name)).venues;
      this.draw();
    } catch (error) {
      showError(this.error, error);
    }
  }

  /** Choose a venue by its id and show one of its plans: `planId`, by default the first; null shows none. */
  async choose(id: string, planId?: string | null): Promise<void> {
    await attempt(this.error, async () => {
      const [venue, { plans, next_cursor: more }] = await Promise.all([api.venue(id), api.venuePlans(id)]);
      this.current = { ...venue, listed: plans };
      byId("venue-name").textContent = venue.name;
      byId("venue-facts").textContent =
        `${venue.plans} ${venue.plans === 1 ? "plan" : "plans"}` +
        (more === null ? "" : `; the list shows the first ${plans.length}`);
      // Plans of a file are named after it and their level; the list would show no more than the file.
      const prefix = `${venue.name} – `,
        all = plans.every(({ name }) => name.startsWith(prefix));
      show(
        this.choice,
        ...plans.map((plan) =>
          h("option", { value: plan.floorplan_id }, all ? plan.name.slice(prefix.length) : planLabel(plan)),
        ),
      );
      this.bar.hidden = false;
      this.draw();
      this.actions.chosen(this.current);
      const first = planId === undefined ? plans[0]?.floorplan_id : planId;
      if (first) this.actions.showPlan(first);
    });
  }

  /** Search a single plan again. */
  leave(): void {
    if (this.current === null) return;
    this.current = null;
    this.bar.hidden = true;
    this.draw();
    this.actions.chosen(null);
  }

  /** Mark the plan that is shown. */
  mark(planId: string): void {
    this.choice.value = planId;
  }

  private draw(): void {
    const entries = this.found.map((venue) => {
      const facts = [`venue, ${venue.plans} plans`, storedAs(venue, this.found)].filter(Boolean).join(", ");
      return h(
        "li",
        {},
        planButton(venue.name, facts, venue.id === this.current?.id, () => this.pick(venue.id)),
      );
    });
    show(this.list, ...entries);
    byId("venues").hidden = this.found.length === 0;
  }
}
