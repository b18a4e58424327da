/** Page at /: one plan or venue, photographs, and where they were taken. */

import { AnswerController } from "./answer_controller";
import { linkedAnswer } from "./answer_link";
import { api } from "./api";
import { byId, named } from "./dom";
import { Editor } from "./editor/editor";
import { exampleFiles, examplePlan, TURN } from "./example";
import { connectGuide } from "./guide";
import { connectKeyDialog } from "./key_dialog";
import { LookAround } from "./look/look_around";
import { PhoneLink } from "./look/phone_link";
import { attempt, clearErrors, connectNumbers, InputError, say, showError } from "./notices";
import { showCaption } from "./plan_caption";
import { PlanScene } from "./plan_scene";
import { Plans } from "./plans";
import { LiveSession } from "./session";
import type { Place } from "./query";
import type { ChosenVenue, Plan, PlanDocument } from "./types";
import { Venues } from "./venues";

// For tests.
export { quoted } from "./all_answers";
export { layoutLines } from "./layout";
export { cameraAttitude } from "./look/orientation";
export { toEarth, toPlan } from "./earth";
export { heatMap } from "./heat";
export { placesOf, remainder } from "./places";

class Page {
  private readonly scene: PlanScene = new PlanScene({
    store: async () => this.scene.plan ?? this.storeExample(),
    viewed: (visible) => {
      this.answers.hints.draw(visible);
      if (this.editor.isOpen) this.editor.redraw();
      else this.scene.drawNames();
    },
    moved: (pose) => this.answers.move(pose),
    select: (index) => this.answers.select(index),
    choose: (photo) => this.answers.photos.choose(photo),
  });
  private readonly venues = new Venues({
    chosen: (venue) => this.onVenue(venue),
    showPlan: (planId) => void this.plans.choose(planId),
  });
  private readonly plans = new Plans({
    chosen: (plan) => this.onPlan(plan),
    started: () => this.onStarted(),
    picked: () => this.venues.leave(),
    listed: (plans) => this.venues.offer(plans),
    imported: (venue, isShown) => void (isShown ? this.venues.take(venue) : this.venues.load("")),
    searched: (name) => void this.venues.load(name),
    example: (plan, photos, isTurn) => {
      if (plan !== null) this.onExample(plan);
      this.answers.photos.addExample(photos, isTurn);
    },
  });
  private readonly answers = new AnswerController(this.scene, {
    place: (signal) => this.place(signal),
    showPlan: (planId, revision) => this.plans.choose(planId, revision),
  });
  private readonly editor = new Editor(this.scene, (stored) => this.onEdited(stored));
  private readonly session = new LiveSession({
    place: () => this.place(),
    showPlan: (planId) => void this.plans.choose(planId),
    opened: () => {
      this.onStarted();
      this.answers.photos.choose(null);
    },
  });
  private readonly look = new LookAround(this.answers);
  private readonly phone = new PhoneLink();
  /** True once the user has chosen a plan, which the example must not replace. */
  private hasStarted = false;

  async start(): Promise<void> {
    const { scene, answers, editor, session } = this;
    connectKeyDialog();
    connectNumbers();
    connectGuide();
    scene.arrange(editor.underlay.element, answers.hints.element, [session.layer, ...editor.layers]);
    byId("edit-plan").addEventListener("click", () => this.edit(scene.plan));
    byId("draw-plan").addEventListener("click", () => this.edit(null));
    byId("look-around").addEventListener("click", () => void this.look.open());
    // Phones have no use for a code.
    byId("phone-link").hidden = !matchMedia("(pointer: fine)").matches;
    byId("phone-link").addEventListener("click", () => void this.showPhoneLink());
    addEventListener("hashchange", () => void (editor.isOpen ? say("Save or stop editing first.") : this.open()));
    await answers.start();
    const [stored] = await Promise.all([this.plans.load(), this.venues.load("")]);
    if (await this.open()) return;
    const example = await examplePlan(TURN);
    // The user may have chosen a plan while the example was loading.
    if (this.hasStarted) return;
    const known = stored.find((plan) => plan.name === example.name);
    if (known !== undefined || stored.length === 0) {
      if (known === undefined) this.onExample(example);
      else await this.plans.choose(known.id);
      const files = await exampleFiles(TURN);
      if (!this.hasStarted && answers.photos.list.length === 0) answers.photos.addExample(files, true);
    } else await this.plans.choose(stored[0]!.id);
  }

  /** React to the choice of a plan, venue or answer, which a running query would replace. */
  private onStarted(): void {
    this.hasStarted = true;
    this.answers.cancelQuery();
  }

  private async showPhoneLink(): Promise<void> {
    await attempt(byId("plan-error"), async () => {
      this.phone.open((this.scene.plan ?? (await this.storeExample())).id);
    });
  }

  /** Show the plan, the answer or the session that the address names, if any. */
  private async open(): Promise<boolean> {
    const planId = named("plan");
    if (planId !== null) {
      await this.plans.choose(planId);
      return true;
    }
    const id = named("answer"),
      packed = named("answer-data");
    if (id === null && packed === null) return this.session.follow(named("session"));
    this.answers.cancelQuery();
    await attempt(byId("plan-error"), async () => {
      const answer = packed === null ? await api.answer(id!) : await linkedAnswer(packed);
      if (answer.venue_id != null) await this.venues.choose(answer.venue_id, null);
      else this.venues.leave();
      await this.plans.choose(answer.floorplan_id, answer.floorplan_revision);
      this.answers.photos.choose(null);
      this.answers.show(answer);
    });
    return true;
  }

  private onExample(example: PlanDocument): void {
    clearErrors();
    this.scene.setPlan(null, example);
    showCaption(null, example);
    this.answers.offerHints();
    this.draw();
  }

  private onVenue(venue: ChosenVenue | null): void {
    if (venue === null) this.answers.cancelQuery();
    else this.onStarted();
    this.answers.setVenue(venue);
    if (venue !== null && venue.plans === 0) showError(byId("plan-error"), new InputError("This venue has no plans."));
  }

  private onPlan(plan: Plan | null): void {
    const before = this.scene.plan;
    const isOther = plan !== null && plan.revision !== before?.revision;
    if (isOther && !this.editor.isOpen) clearErrors();
    this.scene.setPlan(plan);
    showCaption(plan);
    if (plan !== null && !isOther) return;
    if (plan !== null && this.venues.current !== null) this.venues.mark(plan.id);
    else this.answers.forget(plan === null || (before !== null && before.id !== plan.id));
    this.draw();
    this.answers.setPlan(plan);
  }

  private draw(): void {
    this.scene.draw();
    this.session.drawOn(this.scene.plan?.id, this.scene.box);
  }

  private edit(plan: Plan | null): void {
    this.onStarted();
    this.plans.discardPending();
    this.answers.show(null);
    document.body.classList.add("editing");
    byId("plan-name").textContent = plan?.name ?? "New plan";
    this.editor.open(plan);
  }

  private onEdited(stored: Plan | null): void {
    document.body.classList.remove("editing");
    if (stored === null) {
      this.draw();
      byId("plan-name").textContent = this.scene.document?.name ?? "No plan chosen";
      this.answers.restore();
    } else {
      this.answers.forget(false);
      this.plans.take(stored);
      void this.plans.load();
    }
  }

  /** Return what to search: what the user chose last, also if it is still loading. */
  private async place(signal?: AbortSignal): Promise<Place> {
    await this.plans.settled();
    return this.venues.current ?? this.scene.plan ?? this.storeExample(signal);
  }

  private async storeExample(signal?: AbortSignal): Promise<Plan> {
    const { document: example } = this.scene;
    if (example === null) throw new InputError("Choose or upload a floor plan first.");
    const plan = await api.createPlan(example);
    if (signal?.aborted !== true) this.plans.take(plan);
    await this.plans.load();
    return plan;
  }
}

void new Page().start();
