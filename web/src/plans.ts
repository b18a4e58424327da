/** Stored plans: list, search, upload, progress, deletion. */

import type { ImportStep } from "../../clients/typescript/src/index";
import { api, ServiceError } from "./api";
import { button, byId, confirmed, h, planButton, show } from "./dom";
import { acceptChoice, acceptDrops } from "./drops";
import { eventsOf } from "./events";
import { type Example, exampleFiles, examplePlan, ROOMS, SPHERES, TURN } from "./example";
import { checkPixels, hasOptions, ImportForm, PICTURES } from "./import_form";
import { attempt, clearError, say, showError } from "./notices";
import { storedAs } from "./plan_caption";
import type { Plan, PlanDocument, PlanSummary } from "./types";

/** True if the import guessed nothing that the user may want to correct. */
const isCertain = (plan: Plan): boolean =>
  !plan.import_report?.is_draft && (plan.import_report?.unsure ?? []).length === 0;

/** Return a function that shows the steps of a file's import. */
const showStep =
  (file: File) =>
  ({ step, done, total }: ImportStep): void => {
    const part = total === undefined || total < 2 ? "" : ` (${(done ?? 0) + 1} of ${total})`;
    byId("plan-state").textContent = `Importing “${file.name}”: ${step}${part} …`;
  };

const SEARCH_AFTER_MS = 250;

export interface PlanActions {
  /** A plan is to be shown; called again when its progress changes. */
  chosen: (plan: Plan | null) => void;
  /** The list shows these plans. */
  listed: (plans: PlanSummary[]) => void;
  /** The user starts with a plan of their own. */
  started: () => void;
  /** The user picked a plan from the list or uploaded one. */
  picked: () => void;
  /** All levels of a file were stored as a venue, which is to be shown unless the user did something else meanwhile. */
  imported: (venue: { id: string }, isShown: boolean) => void;
  /** The user picked an example; the plan is null if it is stored already. */
  example: (plan: PlanDocument | null, photos: File[], isTurn: boolean) => void;
  /** The user searches for a name. */
  searched: (name: string) => void;
}

export class Plans {
  private readonly list = byId("plan-list");
  private readonly search = byId<HTMLInputElement>("plan-search");
  private readonly error = byId("plan-error");
  private readonly menu = byId<HTMLDetailsElement>("plan-menu");
  private readonly importing = new ImportForm(
    (file, fields) => void this.upload(file, fields),
    (file, fields) => void this.upload(file, fields, true),
    () => this.closeImport(),
  );
  /** Plans that files are stored as; all levels of a file replace one that was not edited. */
  private readonly drafts = new WeakMap<File, Plan>();
  private readonly more = button("More", () => void this.load(this.cursor), { id: "plan-more" });
  private found: PlanSummary[] = [];
  private cursor: string | null = null;
  private current: Plan | null = null;
  private following: AbortController | null = null;
  /** Number of requests to show a plan; only the latest one counts. */
  private requests = 0;
  /** The user's latest choice of a plan. */
  private pending: Promise<unknown> = Promise.resolve();

  constructor(private readonly actions: PlanActions) {
    let waiting: number | undefined;
    this.search.addEventListener("input", () => {
      clearTimeout(waiting);
      waiting = window.setTimeout(() => {
        void this.load();
        actions.searched(this.search.value.trim());
      }, SEARCH_AFTER_MS);
    });
    this.connectMenu();
    for (const [name, example] of Object.entries({ turn: TURN, spheres: SPHERES, rooms: ROOMS }))
      byId(`example-${name}`).addEventListener("click", () => (this.pending = this.pickExample(example)));
    acceptChoice(byId("plan-file"), ([file]) => void this.begin(file!));
    acceptDrops(byId("plan-panel"), ([file]) => {
      if (file !== undefined) void this.begin(file);
    });
  }

  /** Close the menu after a choice, with Escape, and with a click outside. */
  private connectMenu(): void {
    addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !this.menu.open) return;
      this.menu.open = false;
      this.menu.querySelector("summary")?.focus();
    });
    addEventListener("pointerdown", ({ target }) => {
      const isInside = target instanceof Node && (this.menu.contains(target) || byId("delete-dialog").contains(target));
      if (!isInside) this.menu.open = false;
    });
  }

  /** Load the list, or with a cursor its next page; return the listed plans. */
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

  choose(id: string, revision?: string): Promise<Plan | null> {
    return (this.pending = this.open(id, revision));
  }

  /** Wait until the plan that was chosen last is shown, or cannot be. */
  async settled(): Promise<void> {
    let last: Promise<unknown>;
    do await (last = this.pending).catch(() => undefined);
    while (last !== this.pending);
  }

  private async open(id: string, revision?: string): Promise<Plan | null> {
    this.closeImport();
    const request = this.discardPending();
    try {
      const plan = await api.plan(id, revision);
      if (request === this.requests) this.take(plan);
      return this.current;
    } catch (error) {
      if (request === this.requests) showError(this.error, error);
      return null;
    }
  }

  private async pickExample(example: Example): Promise<void> {
    this.actions.started();
    this.actions.picked();
    this.menu.open = false;
    const request = this.discardPending();
    const [plan, photos, stored] = await Promise.all([examplePlan(example), exampleFiles(example), this.load()]);
    if (request !== this.requests) return;
    const known = stored.find(({ name }) => name === plan.name);
    if (known === undefined) this.take(null);
    else await this.open(known.id);
    this.actions.example(known === undefined ? plan : null, photos, example === TURN);
  }

  /** Ignore the results of earlier requests to show a plan. */
  discardPending(): number {
    return ++this.requests;
  }

  /** Show no plan, as it was deleted. */
  private showNone(): void {
    this.actions.started();
    this.take(null);
  }

  take(plan: Plan | null): void {
    this.current = plan;
    this.actions.chosen(plan);
    this.draw();
    this.following?.abort();
    if (plan !== null && plan.status === "preparing") void this.follow(plan);
  }

  /** Pictures seldom state their scale, so the form asks for it first, unless the service would refuse the file. */
  private async begin(file: File): Promise<void> {
    if (document.body.classList.contains("editing"))
      return say(`Save or stop editing first, then add “${file.name}” again.`);
    this.actions.started();
    const request = this.discardPending(),
      isPicture = PICTURES.test(file.type);
    clearError(this.error, this.importing.fields);
    try {
      if (isPicture) await checkPixels(file);
    } catch (error) {
      this.importing.close();
      showError(this.error, error);
      return;
    }
    if (request !== this.requests) return;
    if (isPicture) this.importing.ask(file, true);
    else await this.upload(file);
  }

  private closeImport(): void {
    clearError(this.error, this.importing.fields);
    this.importing.close();
  }

  /** Upload a file as a plan, or all of its levels as plans and their venue. */
  async upload(file: File, fields: Record<string, string> = {}, isAll = false): Promise<void> {
    clearError(this.error, this.importing.fields);
    // The form of the previous file does not apply to this one.
    if (!isAll && Object.keys(fields).length === 0) this.importing.close();
    const request = this.discardPending(),
      isLast = (): boolean => request === this.requests,
      state = byId("plan-state");
    state.textContent = `Importing ${isAll ? "all levels of " : ""}“${file.name}” …`;
    try {
      const stored = await api[isAll ? "uploadLevels" : "uploadPlan"](file, fields, { onStep: showStep(file) });
      const draft = isAll && this.drafts.get(file);
      if (draft && (await api.plan(draft.id).catch(() => null))?.revision === draft.revision)
        await api.deletePlan(draft.id);
      const isShown = isLast();
      if (!("plan" in stored)) {
        this.importing.close(file);
        this.actions.imported(stored, isShown);
      } else if (isShown) {
        this.actions.picked();
        this.take(stored);
        this.drafts.set(file, stored);
        if (isCertain(stored)) this.importing.close();
        else this.importing.ask(file, false, stored.import_report?.levels, stored.import_report?.scale_factor);
      }
      await this.load();
      say(`“${stored.name}” is stored${isShown ? "" : ": choose it under “Plans”"}.`);
    } catch (error) {
      const levels = error instanceof ServiceError ? error.levels : [];
      if (!isAll && isLast() && (levels.length > 0 || hasOptions(file))) this.importing.ask(file, true, levels);
      if (!isLast() || (levels.length === 0 && !this.importing.askForScale(error)))
        showError(this.error, error, this.importing.fields);
    } finally {
      if (state.textContent.includes(`“${file.name}”`)) state.textContent = "";
    }
  }

  private async follow(plan: Plan): Promise<void> {
    const { signal } = (this.following = new AbortController());
    try {
      for await (const event of eventsOf(plan.id, signal)) {
        if (this.current?.id !== plan.id) continue;
        if (event.status === "preparing") this.actions.chosen({ ...this.current, progress: event.progress ?? 0 });
        else if (event.status === "deleted") this.showNone();
        else void this.renew(plan.id);
      }
    } catch (error) {
      if (!signal.aborted) showError(this.error, error);
    }
  }

  /** Load a plan again, unless the user has chosen another one. */
  private async renew(id: string): Promise<void> {
    const request = this.requests;
    try {
      const plan = await api.plan(id);
      if (request === this.requests && this.current?.id === id) this.take(plan);
    } catch (error) {
      if (request === this.requests) showError(this.error, error);
    }
    await this.load();
  }

  private pick(id: string): void {
    this.menu.open = false;
    this.actions.started();
    this.actions.picked();
    void this.choose(id);
  }

  private async remove(plan: PlanSummary): Promise<void> {
    byId("delete-what").textContent = `Delete “${plan.name}” with all its revisions? This cannot be undone.`;
    if (!(await confirmed("delete-dialog", "delete"))) return;
    await attempt(this.error, async () => {
      await api.deletePlan(plan.id);
      say(`“${plan.name}” is deleted.`);
      if (this.current?.id === plan.id) this.showNone();
      await this.load();
    });
  }

  private draw(): void {
    const entries = this.found.map((plan) => {
      const { id, name } = plan;
      const done = Math.round(100 * plan.progress);
      const state = { preparing: `preparing, ${done} %`, failed: "failed", ready: "" }[plan.status];
      const size = `${plan.rooms} ${plan.rooms === 1 ? "room" : "rooms"}, ${plan.area_m2.toFixed(0)} m²`;
      const facts = [size, state, storedAs(plan, this.found)].filter(Boolean).join(", ");
      const choose = planButton(name, facts, id === this.current?.id, () => this.pick(id));
      const remove = button("×", () => void this.remove(plan), { class: "remove", "aria-label": `Delete ${name}` });
      return h("li", {}, choose, remove);
    });
    show(this.list, ...entries, this.cursor !== null && h("li", {}, this.more));
    byId("plan-none").hidden = this.found.length > 0;
    byId("plan-none").textContent =
      this.search.value.trim() === "" ? "No plan is stored yet." : "No plan with this name.";
  }
}
