/** Plans that pins lie in: that of the album, or those of its venue, which are loaded when they are needed. */

import { api } from "./api";
import { h, s, show } from "./dom";
import { nameIn } from "./plan_caption";
import { boxOf, path } from "./plan_drawing";
import type { Layout, Plan, PlanSummary, RoomLayout, Venue } from "./types";
import { planLabel } from "./venues";
import type { Schemas } from "../../clients/typescript/src/index";

export type Row = Schemas["AlbumPhotographAnswer"];
export type PinnedAt = Schemas["PinPlace"];

export interface Floor {
  plan: Plan;
  layout: Layout;
}

const choicesOf = (kind: string, places: (PlanSummary | Venue)[]): HTMLOptionElement[] =>
  places.map((place) => h("option", { value: `${kind}:${place.id}` }, nameIn(place, places)));

/** List the first page of something in a group of choices; return a function that lists the others. */
async function listPages<P extends { next_cursor: string | null }>(
  group: HTMLElement,
  read: (name: string, cursor: string | null) => Promise<P>,
  optionsOf: (page: P) => HTMLOptionElement[],
): Promise<() => Promise<void>> {
  let page = await read("", null);
  group.append(...optionsOf(page));
  return async () => {
    while (page.next_cursor !== null) group.append(...optionsOf((page = await read("", page.next_cursor))));
  };
}

/** List plans, venues and saved folders as groups of choices, the first page of each; return functions for the others. */
export async function listPlaces(choice: HTMLElement, saved: HTMLElement): Promise<(() => Promise<void>)[]> {
  const [plans, venues] = [h("optgroup", { label: "Plans" }), h("optgroup", { label: "Venues" })];
  const rests = await Promise.all([
    listPages(plans, api.plans, (page) => choicesOf("plan", page.floorplans)),
    listPages(venues, api.venues, (page) => choicesOf("venue", page.venues)),
    listPages(saved, api.albums, (page) => page.albums.map(folderOption)),
  ]);
  show(choice, ...[plans, venues, saved].filter((group) => group.childElementCount > 0));
  return rests;
}

/** Return a saved folder as a choice, by its date, which a long name would cut off, and its name. */
export function folderOption(album: Pick<Schemas["AlbumSummary"], "id" | "name" | "updated_at">): HTMLOptionElement {
  const date = new Date(album.updated_at).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
  return h("option", { value: `album:${album.id}` }, `${date}, ${album.name}`);
}

export class Floors {
  private readonly loaded = new Map<string, Floor>();
  private levels: Schemas["VenuePlanList"]["plans"] = [];
  /** The venue; null for one plan. */
  venue: string | null = null;

  async takePlan(plan: Plan): Promise<void> {
    this.venue = null;
    this.levels = [];
    this.loaded.clear();
    await this.put(plan);
  }

  /** Begin with a venue and its plans; return the id of the first one. */
  takeVenue(id: string, plans: Schemas["VenuePlanList"]["plans"]): string | null {
    this.venue = id;
    this.levels = plans;
    this.loaded.clear();
    return plans[0]?.floorplan_id ?? null;
  }

  get(planId: string | undefined): Floor | null {
    return this.loaded.get(planId ?? "") ?? null;
  }

  /** Return the plans of the venue with their names; none for one plan. */
  get names(): [string, string][] {
    return this.levels.map((plan) => [plan.floorplan_id, planLabel(plan)]);
  }

  /** Load the plans of some ids; those that were deleted are left out. */
  async load(ids: Iterable<string>): Promise<void> {
    for (const id of new Set(ids))
      if (!this.loaded.has(id))
        await api.plan(id).then(
          (plan) => this.put(plan),
          () => undefined,
        );
  }

  /** Load all plans again that have a new revision; return true if there was one. */
  async refresh(): Promise<boolean> {
    let isNew = false;
    for (const [id, { plan }] of this.loaded) {
      const now = await api.plan(id);
      if (now.revision === plan.revision) continue;
      await this.put(now);
      isNew = true;
    }
    return isNew;
  }

  private async put(plan: Plan): Promise<void> {
    this.loaded.set(plan.id, { plan, layout: await api.layout(plan.id) });
  }

  /** Return the room of a place. */
  room(place: PinnedAt): RoomLayout | null {
    return this.get(place.floorplan_id)?.layout.rooms.find(({ id }) => id === place.room_id) ?? null;
  }

  /** Return a small drawing of the plan with a spot at a place. */
  smallPlan(place: PinnedAt): SVGElement | null {
    const floor = this.get(place.floorplan_id);
    if (floor === null) return null;
    const box = boxOf(floor.plan.plan),
      size = Math.max(box.width, box.height);
    const [x, y] = [place.position.x_m, -place.position.y_m];
    const arrow = `M${-0.04 * size} ${-0.035 * size}L0 ${-0.12 * size}L${0.04 * size} ${-0.035 * size}Z`;
    return s(
      "svg",
      { viewBox: `${box.x} ${box.y} ${box.width} ${box.height}`, "aria-hidden": true, class: "small" },
      s("path", {
        class: "outline",
        d: floor.plan.plan.rooms.map((room) => path(room.polygon)).join(""),
        "stroke-width": 0.012 * size,
      }),
      place.heading_deg !== null &&
        s("path", { class: "spot", d: arrow, transform: `translate(${x} ${y}) rotate(${place.heading_deg})` }),
      s("circle", { class: "spot", cx: x, cy: y, r: 0.045 * size }),
    );
  }
}
