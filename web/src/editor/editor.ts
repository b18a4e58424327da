/** Plan editor: changes a copy, with undo and redo, and stores it as a new revision or a new plan. */

import { api, ServiceError } from "../api";
import { button, byId, confirmed, h, show } from "../dom";
import { attempt, clearError, InputError, say, showError } from "../notices";
import { boxOf, lostAreas, unitOf } from "../plan_drawing";
import type { PlanScene } from "../plan_scene";
import type { Plan, PlanDocument, Point } from "../types";
import * as change from "./changes";
import { setFormPlan, showForm } from "./forms";
import { type EditActions, Handles, type Selection } from "./handles";
import { History } from "./history";
import { type Tool, Tools } from "./tools";
import { TracedPictures, Underlay } from "./underlay";

const EMPTY: PlanDocument = { name: "New plan", rooms: [], openings: [] };
const NEW_ROOM_M: Point = [4, 3];
// Movement of the pointer from which on a click is a drag.
const CLICK_PX = 4;
const TOOLS: [Tool, string][] = [
  ["select", "Select"],
  ["room", "Draw a room"],
  ["door", "Door"],
  ["window", "Window"],
  ["passage", "Passage"],
  ["scale", "Scale"],
];

export class Editor {
  readonly underlay: Underlay;
  private readonly handles: Handles;
  private readonly tools: Tools;
  private readonly bar = byId("plan-tools");
  private readonly form = byId("plan-form");
  private readonly error = byId("plan-error");
  private readonly hint = h("p", { class: "hint", role: "status", id: "edit-hint" });
  private readonly measure = h("div", { class: "measure", hidden: true });
  private readonly undo = button("Undo", () => this.step("undo"), { id: "undo" });
  private readonly redo = button("Redo", () => this.step("redo"), { id: "redo" });
  private history: History<PlanDocument> | null = null;
  private saved: PlanDocument = EMPTY;
  private base: Plan | null = null;
  private selection: Selection = { kind: "none" };
  private measured = 0;
  /** Factors by which plans of the history were scaled. */
  private readonly factors = new WeakMap<PlanDocument, number>();
  private readonly traced = new TracedPictures();
  private readonly actions: EditActions = {
    edit: (plan, goesOn) => this.edit(plan, goesOn),
    select: (selection) => this.select(selection),
  };

  /** `ended` is called when editing ends, with null if nothing was stored. */
  constructor(
    private readonly scene: PlanScene,
    private readonly ended: (stored: Plan | null) => void,
  ) {
    const { svg } = scene;
    this.underlay = new Underlay(svg);
    this.handles = new Handles(svg, this.actions);
    this.tools = new Tools(svg, {
      edit: (plan) => {
        const isRoom = plan.rooms.length > (this.history?.now.rooms.length ?? 0);
        const index = (isRoom ? plan.rooms : (plan.openings ?? [])).length - 1;
        return this.edit(plan, false, { kind: isRoom ? "room" : "opening", index });
      },
      done: () => this.drawBar(),
      measured: (distance) => this.onMeasured(distance),
      instruct: (text) => show(this.hint, text),
    });
    svg.addEventListener("pointerdown", (event) => this.onGround(event));
    addEventListener("keydown", (event) => this.onKey(event));
    addEventListener("beforeunload", (event) => {
      if (this.isChanged) event.preventDefault();
    });
  }

  /** Layers over the plan while it is edited. */
  get layers(): SVGElement[] {
    return [this.handles.element, this.tools.element];
  }

  get isOpen(): boolean {
    return this.history !== null;
  }

  private get isChanged(): boolean {
    return this.history !== null && this.history.now !== this.saved;
  }

  /** Open a stored plan, or a new one. */
  open(plan: Plan | null): void {
    this.base = plan;
    this.saved = plan?.plan ?? EMPTY;
    this.history = new History(this.saved);
    this.selection = { kind: "none" };
    this.underlay.remove();
    clearError(this.error);
    this.tools.choose(plan === null ? "room" : "select");
    this.scene.viewport.fit(boxOf(this.saved, lostAreas(plan)));
    this.drawBar();
    this.redraw();
    if (plan !== null) void this.layOriginal(plan);
  }

  /** Lay the picture under a plan that it was drawn over before, or read from. */
  private async layOriginal(plan: Plan): Promise<void> {
    try {
      const traced = await this.traced.of(plan);
      if (traced === null || !this.isOpen || this.base?.revision !== plan.revision) return;
      await this.underlay.lay(traced);
      this.drawBar();
    } catch {
      // The picture is optional.
    }
  }

  /** Redraw, as after zooming. */
  redraw(): void {
    if (this.history === null) return;
    const plan = this.history.now,
      unit = unitOf(this.scene.viewport.current);
    setFormPlan(plan);
    this.scene.drawRooms(plan);
    this.tools.update(plan, unit);
    this.handles.draw(plan, this.selection, unit);
    showForm(this.form, plan, this.selection, this.actions);
  }

  /** Take a changed plan; return false, and say why, if it is refused. */
  private edit(plan: PlanDocument, goesOn = false, selection = this.selection): boolean {
    // Moved to where it was: nothing to undo.
    if (!goesOn && JSON.stringify(plan) === JSON.stringify(this.history?.now)) return false;
    const overlap = this.history && change.overlapIn(plan, this.history.now);
    if (overlap === null) this.put(plan, goesOn, selection);
    else {
      say(overlap);
      // The form shows the value that is refused.
      delete this.form.dataset.of;
      this.redraw();
    }
    return overlap === null;
  }

  private put(plan: PlanDocument, goesOn: boolean, selection: Selection): void {
    this.selection = selection;
    this.history?.push(plan, goesOn);
    this.redraw();
    this.drawUndo();
  }

  private select(selection: Selection): void {
    this.selection = selection;
    this.redraw();
  }

  private close(stored: Plan | null): void {
    if (stored !== null && this.history !== null) {
      const types = change.typesByName(this.history.now, stored.plan);
      const picture = this.underlay.traced && " The picture below it stays until this page is closed.";
      say(`“${stored.name}” is stored, revision ${stored.revision_number}.${types}${picture ?? ""}`);
      this.traced.keep(stored.id, this.underlay.traced);
    }
    this.history = null;
    this.underlay.remove();
    this.tools.choose("select");
    show(this.bar);
    show(this.form);
    show(this.handles.element);
    this.measure.hidden = true;
    this.ended(stored);
  }

  private drawBar(): void {
    if (this.history === null) return;
    const { slider, box } = this.underlay;
    const tool = ([name, label]: [Tool, string]): HTMLElement =>
      button(
        label,
        () => {
          this.measure.hidden = true;
          this.tools.choose(name);
          this.drawBar();
        },
        { "aria-pressed": String(this.tools.current === name), id: `tool-${name}` },
      );
    const picture = h("input", { type: "file", accept: "image/png,image/jpeg,image/webp", id: "underlay-file" });
    picture.addEventListener("change", () => {
      if (picture.files?.[0]) void this.lay(picture.files[0]);
    });
    show(
      this.bar,
      h(
        "div",
        { class: "tools", role: "toolbar", "aria-label": "Editing" },
        ...TOOLS.map(tool),
        button("Add 4 × 3 m room", () => this.addRoom(), { id: "add-room" }),
        h("label", { class: "file" }, picture, h("span", {}, "Picture to trace")),
        this.undo,
        this.redo,
      ),
      box !== null && h("label", { class: "inline", for: slider.id }, "Picture through the rooms", slider),
      this.measure,
      this.hint,
      h(
        "div",
        { class: "ask" },
        button(this.base === null ? "Store the plan" : "Save as a new revision", () => void this.save(), {
          class: "primary",
          id: "save",
        }),
        this.base !== null && button("Save as a new plan", () => void this.saveNew(), { id: "save-new" }),
        button("Stop editing", () => void this.leave(), { id: "stop" }),
      ),
    );
    this.drawUndo();
  }

  private drawUndo(): void {
    this.undo.disabled = !this.history?.canUndo;
    this.redo.disabled = !this.history?.canRedo;
  }

  private step(way: "undo" | "redo"): void {
    if (this.history === null) return;
    const before = this.history.now;
    this.history[way]();
    const { now } = this.history,
      elements = this.selection.kind === "room" ? now.rooms : (now.openings ?? []);
    // The picture below was scaled with the plan.
    if (now !== before)
      this.underlay.scale(way === "redo" ? (this.factors.get(now) ?? 1) : 1 / (this.factors.get(before) ?? 1));
    if (this.selection.kind !== "none" && this.selection.index >= elements.length) this.selection = { kind: "none" };
    this.redraw();
    this.drawUndo();
  }

  private addRoom(): void {
    if (this.history === null) return;
    const plan = this.history.now,
      right =
        plan.rooms.length === 0 ? 0 : Math.max(...plan.rooms.flatMap(({ polygon }) => polygon.map(([x]) => x))) + 0.1;
    const [width, depth] = NEW_ROOM_M;
    this.tools.choose("select");
    const corners = [0, width, width, 0].map((x, index): Point => [right + x, index < 2 ? 0 : depth]);
    this.edit(change.addRoom(plan, corners), false, { kind: "room", index: plan.rooms.length });
    this.scene.viewport.fit(boxOf(this.history.now));
  }

  private async lay(file: File): Promise<void> {
    await attempt(this.error, async () => {
      await this.underlay.lay({ file, name: file.name });
      const { width, height } = this.underlay.box!;
      this.scene.viewport.fit({ x: -0.5, y: -height - 0.5, width: width + 1, height: height + 1 });
      say("Set the scale next: click two points with a known distance.");
      this.tools.choose("scale");
      this.drawBar();
    });
  }

  private onMeasured(distance: number): void {
    this.measured = distance;
    const field = h("input", {
      type: "number",
      min: 0.01,
      step: "any",
      id: "known-distance",
      value: distance.toFixed(2),
    });
    const apply = (): void => this.applyScale(field.valueAsNumber);
    field.addEventListener("keydown", (event) => {
      if (event.key === "Enter") apply();
    });
    show(
      this.measure,
      h("label", { for: "known-distance" }, "Real distance of these points in metres:"),
      field,
      button("Set the scale", apply, { id: "apply-scale" }),
    );
    this.measure.hidden = false;
    field.select();
  }

  private applyScale(distance: number): void {
    if (this.history === null || !(distance > 0) || !(this.measured > 0))
      return showError(this.error, new InputError("The distance must be more than 0 m, between two different points."));
    clearError(this.error);
    const factor = distance / this.measured,
      { viewport } = this.scene,
      seen = viewport.current;
    this.measure.hidden = true;
    this.underlay.scale(factor);
    this.tools.choose("select");
    const plan = change.scaled(this.history.now, factor);
    this.factors.set(plan, factor);
    this.put(plan, false, this.selection);
    viewport.fit({ x: seen.x * factor, y: seen.y * factor, width: seen.width * factor, height: seen.height * factor });
    say(`The plan was scaled by ${factor.toFixed(3)}.`);
  }

  private async save(): Promise<void> {
    if (this.history === null) return;
    if (this.base === null) return this.saveNew();
    const document = this.history.now;
    await this.attempt(async (base) => this.close(await api.replacePlan(base.id, document, base.etag)));
  }

  private async saveNew(): Promise<void> {
    const plan = this.history?.now;
    if (plan !== undefined) await this.attempt(async () => this.close(await api.createPlan(plan)));
  }

  private async attempt(store: (base: Plan) => Promise<void>): Promise<void> {
    clearError(this.error);
    // A second click would store the plan again.
    this.bar.inert = true;
    try {
      await store(this.base!);
    } catch (error) {
      showError(this.error, error);
      if (error instanceof ServiceError && error.status === 412) this.offerResolutions();
    } finally {
      this.bar.inert = false;
    }
  }

  /** Offer ways to keep both versions after somebody else stored a revision. */
  private offerResolutions(): void {
    show(
      this.error,
      h("strong", {}, "Somebody changed this plan while you were editing"),
      h("p", {}, "Both versions are kept. Choose what to do with yours."),
      h(
        "div",
        { class: "ask" },
        button("Show their version", () => void this.loadTheirs(true), { id: "look-at-theirs" }),
        button("Overwrite it with mine", () => void this.loadTheirs(false), { id: "save-over" }),
        button("Save mine as a new plan", () => void this.saveNew()),
      ),
    );
  }

  private async loadTheirs(isShown: boolean): Promise<void> {
    await this.attempt(async (base) => {
      this.base = await api.plan(base.id);
      if (!isShown) return this.close(await api.replacePlan(base.id, this.history!.now, this.base.etag));
      // One more step of the history, so that undo returns to the user's version.
      this.put(this.base.plan, false, { kind: "none" });
      this.hint.textContent = `This is their revision ${this.base.revision_number}. “Undo” returns to your version; saving makes it the latest.`;
    });
  }

  private async leave(): Promise<void> {
    if (!this.isChanged || (await confirmed("leave-dialog", "leave"))) this.close(null);
  }

  /** Show the form of the whole plan after a click beside the rooms; a drag there moves the drawing. */
  private onGround(event: PointerEvent): void {
    if (this.history === null || event.defaultPrevented || this.handles.element.contains(event.target as Node)) return;
    addEventListener(
      "pointerup",
      (end) => {
        const isClick = Math.hypot(end.clientX - event.clientX, end.clientY - event.clientY) < CLICK_PX;
        if (isClick && this.history !== null) this.select({ kind: "none" });
      },
      { once: true },
    );
  }

  private onKey(event: KeyboardEvent): void {
    if (this.history !== null && event.key === "Escape" && this.tools.current === "select")
      return this.select({ kind: "none" });
    if (this.history === null || event.target instanceof HTMLInputElement || !(event.ctrlKey || event.metaKey)) return;
    const key = event.key.toLowerCase();
    if (key === "z") this.step(event.shiftKey ? "redo" : "undo");
    else if (key === "y") this.step("redo");
    else return;
    event.preventDefault();
  }
}
