/** The stored plans: a list to search and choose from, uploads, how far they are prepared, deleting. */

import { api } from "./api";
import { button, byId, h, show } from "./dom";
import { followPlan } from "./events";
import { ImportForm } from "./import_form";
import { clearError, say, showError } from "./notices";
import { acceptDrops } from "./photos";
import type { Plan, PlanSummary } from "./types";

/** Whether nothing of a plan was guessed that one may want to correct. */
const isSure = (plan: Plan): boolean => !plan.import_report?.is_draft && (plan.import_report?.unsure ?? []).length === 0;

const SEARCH_AFTER_MS = 250;
const PICTURES = /^image\/(png|jpeg)$/;

export interface PlanActions {
  /** A plan is to be shown; told again when it is prepared further. */
  chosen: (plan: Plan | null) => void;
  /** These plans are listed now. */
  listed: (plans: PlanSummary[]) => void;
  /** Somebody begins with a plan of their own. */
  begun: () => void;
  /** Somebody picked a plan of the list, or uploaded one. */
  picked: () => void;
  /** Somebody looks for what has this in its name. */
  searched: (name: string) => void;
}

export class Plans {
  private readonly list = byId("plan-list");
  private readonly search = byId<HTMLInputElement>("plan-search");
  private readonly error = byId("plan-error");
  private readonly importing = new ImportForm((file, fields) => void this.upload(file, fields));
  private readonly more = button("More", () => void this.load(this.cursor), { id: "plan-more" });
  private found: PlanSummary[] = [];
  private cursor: string | null = null;
  private current: Plan | null = null;
  private following: AbortController | null = null;
  /** Counts what was asked to be shown: only the last of it is. */
  private turn = 0;

  constructor(private readonly actions: PlanActions) {
    let waiting: number | undefined;
    this.search.addEventListener("input", () => {
      clearTimeout(waiting);
      waiting = window.setTimeout(() => {
        void this.load();
        actions.searched(this.search.value.trim());
      }, SEARCH_AFTER_MS);
    });
    const input = byId<HTMLInputElement>("plan-file");
    input.addEventListener("change", () => {
      const file = input.files?.[0];
      input.value = "";
      if (file !== undefined) this.begin(file);
    });
    acceptDrops(byId("plan-panel"), (files) => { if (files[0] !== undefined) this.begin(files[0]); });
  }

  /** Fetch the list; with a cursor, its next page. Returns what is listed. */
  async load(cursor: string | null = null): Promise<PlanSummary[]> {
    try {
      const page = await api.plans(this.search.value.trim(), cursor);
      this.found = cursor === null ? page.floorplans : [...this.found, ...page.floorplans];
      this.cursor = page.next_cursor;
      this.draw();
      this.actions.listed(this.found);
    } catch (error) {
      showError(this.error, error);
    }
    return this.found;
  }

  /** Choose a plan by its id. */
  async choose(id: string, revision?: string): Promise<Plan | null> {
    clearError(this.error, this.importing.fields);
    this.importing.close();
    const turn = this.stay();
    try {
      const plan = await api.plan(id, revision);
      if (turn === this.turn) this.take(plan);
      return this.current;
    } catch (error) {
      if (turn === this.turn) showError(this.error, error);
      return null;
    }
  }

  /** Show nothing of what was asked for before. */
  stay(): number {
    return ++this.turn;
  }

  /** Show a plan that was just stored or read. */
  take(plan: Plan | null): void {
    this.current = plan;
    this.actions.chosen(plan);
    this.draw();
    this.following?.abort();
    if (plan !== null && plan.status === "preparing") void this.follow(plan);
  }

  /** A picture never says how large it is: that is asked first. */
  private begin(file: File): void {
    this.actions.begun();
    this.stay();
    clearError(this.error, this.importing.fields);
    if (PICTURES.test(file.type)) this.importing.ask(file, true);
    else void this.upload(file);
  }

  /** Upload a file as a new plan. */
  async upload(file: File, fields: Record<string, string> = {}): Promise<void> {
    clearError(this.error, this.importing.fields);
    // What was asked about the last file is not about this one.
    if (Object.keys(fields).length === 0) this.importing.close();
    const turn = this.stay();
    const state = byId("plan-state");
    state.textContent = `Reading “${file.name}” …`;
    try {
      const plan = await api.uploadPlan(file, fields);
      if (turn === this.turn) {
        this.actions.picked();
        this.take(plan);
        if (isSure(plan)) this.importing.close();
        else this.importing.ask(file, false);
      }
      await this.load();
      say(`“${plan.name}” is stored.`);
    } catch (error) {
      // What is shown would be taken for what was refused.
      if (turn === this.turn) this.take(null);
      this.importing.ask(file, true);
      showError(this.error, error, this.importing.fields);
    } finally {
      if (state.textContent.startsWith("Reading")) state.textContent = "";
    }
  }

  private async follow(plan: Plan): Promise<void> {
    const own = (this.following = new AbortController());
    try {
      await followPlan(plan.id, (event) => {
        if (this.current?.id !== plan.id) return;
        if (event.status === "preparing") this.actions.chosen({ ...this.current, progress: event.progress ?? 0 });
        else if (event.status === "deleted") this.take(null);
        else void this.renew(plan.id);
      }, own.signal);
    } catch (error) {
      if (!own.signal.aborted) showError(this.error, error);
    }
  }

  /** Show how a plan is by now, unless another was asked for meanwhile. */
  private async renew(id: string): Promise<void> {
    const turn = this.turn;
    try {
      const plan = await api.plan(id);
      if (turn === this.turn && this.current?.id === id) this.take(plan);
    } catch (error) {
      if (turn === this.turn) showError(this.error, error);
    }
    await this.load();
  }

  private pick(id: string): void {
    this.actions.begun();
    this.actions.picked();
    void this.choose(id);
  }

  private async remove(plan: PlanSummary): Promise<void> {
    if (!(await this.sure(plan))) return;
    clearError(this.error);
    try {
      await api.deletePlan(plan.id);
      say(`“${plan.name}” is deleted.`);
      if (this.current?.id === plan.id) this.take(null);
      await this.load();
    } catch (error) {
      showError(this.error, error);
    }
  }

  private sure(plan: PlanSummary): Promise<boolean> {
    const dialog = byId<HTMLDialogElement>("delete-dialog");
    byId("delete-what").textContent = `Delete “${plan.name}” with all its revisions, for good?`;
    dialog.showModal();
    return new Promise((resolve) => dialog.addEventListener("close", () => {
      resolve(dialog.returnValue === "delete");
      dialog.returnValue = "";
    }, { once: true }));
  }

  private draw(): void {
    const entries = this.found.map((plan) => {
      const state = plan.status === "preparing" ? `preparing, ${Math.round(100 * plan.progress)} %` : plan.status === "failed" ? "failed" : "";
      const facts = [`${plan.rooms} ${plan.rooms === 1 ? "room" : "rooms"}`, `${plan.area_m2.toFixed(0)} m²`, state];
      const choose = h("button", {
        type: "button", class: "plan", "aria-pressed": String(plan.id === this.current?.id), onclick: () => this.pick(plan.id),
      }, h("span", { class: "name" }, plan.name), h("span", { class: "facts" }, facts.filter(Boolean).join(", ")));
      const remove = h("button", { type: "button", class: "remove", "aria-label": `Delete ${plan.name}`, onclick: () => void this.remove(plan) }, "×");
      return h("li", {}, choose, remove);
    });
    show(this.list, ...entries, this.cursor !== null && h("li", {}, this.more));
    byId("plan-none").hidden = this.found.length > 0;
  }
}
