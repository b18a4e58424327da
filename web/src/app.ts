/** Page at /: one plan, photographs, and where they were taken. */

import { showAll } from "./all_answers";
import { markSelected, showAnswer } from "./answer_panel";
import { companions, ellipse, otherPlaces } from "./answer_overlay";
import { api } from "./api";
import { device } from "./device/device";
import { byId, named, s, scrollTo, show } from "./dom";
import { Editor } from "./editor/editor";
import { exampleFiles, examplePlan, FLAT } from "./example";
import { heatMap } from "./heat";
import { connectGuide, hideGuide } from "./guide";
import { HintForm } from "./hints";
import { connectKeyDialog } from "./key_dialog";
import { layoutLines, roomAt } from "./layout";
import { LocalisabilityLayer } from "./localisability_layer";
import { clearError, InputError, showError } from "./notices";
import { PanoramaView } from "./panorama_view";
import { type Photo, Photos } from "./photos";
import { connectSaveMap, savePicture } from "./pictures";
import { type Box, boxOf, drawNames, drawPlan, lostAreas } from "./plan_drawing";
import { showWarnings } from "./plan_warnings";
import { Plans } from "./plans";
import { PoseMarker, showCursor } from "./pose_marker";
import { askSingle, askTogether } from "./query";
import { LiveSession } from "./session";
import type { Answer, Layout, Plan, PlanDocument, Point, Pose, Venue } from "./types";
import { Venues } from "./venues";
import { Viewport } from "./viewport";

// For tests.
export { layoutLines, layoutView } from "./layout";
export { placesOf, remainder } from "./places";

const DEFAULT_CAMERA_HEIGHT_M = 1.5;

class Page {
  private readonly svg = byId("plan") as unknown as SVGSVGElement;
  private readonly base = s("g");
  private readonly heat = s("g");
  private readonly localisability = new LocalisabilityLayer(
    async () => this.plan ?? this.storeExample(new AbortController().signal),
  );
  private readonly names = s("g");
  private readonly overlay = s("g");
  private readonly marker = new PoseMarker(this.svg, (pose) => this.onMoved(pose));
  private readonly panorama = new PanoramaView(byId("photo-view"), (yaw, fov) => this.marker.look(yaw, fov));
  private readonly venues = new Venues({
    chosen: (venue) => this.onVenue(venue),
    showPlan: (planId) => void this.plans.choose(planId),
  });
  private readonly plans = new Plans({
    chosen: (plan) => this.onPlan(plan),
    started: () => this.onStarted(),
    picked: () => this.venues.leave(),
    listed: (plans) => this.venues.offer(plans),
    imported: (venue) => void this.venues.take(venue),
    searched: (name) => void this.venues.load(name),
    example: (plan, photos) => this.onExamplePicked(plan, photos),
  });
  private readonly photos = new Photos((photo, isOther) => this.onPhoto(photo, isOther));
  private readonly hints = new HintForm(this.svg, (hints) => this.photos.setHints(hints));
  private readonly editor = new Editor(this.svg, {
    draw: (plan) => this.drawRooms(plan),
    visible: () => this.viewport.current,
    fit: (box) => this.viewport.fit(box),
    ended: (stored) => this.onEdited(stored),
  });
  private readonly session = new LiveSession({
    place: async () => this.venues.current ?? this.plan ?? this.storeExample(),
    showPlan: (planId) => void this.plans.choose(planId),
    opened: () => {
      this.onStarted();
      this.photos.choose(null);
    },
  });
  private readonly viewport = new Viewport(this.svg, this.svg.parentElement!, () => this.onViewChanged());
  private readonly find = byId<HTMLButtonElement>("find");
  private plan: Plan | null = null;
  /** The drawn plan: a stored one, or the example before it is stored. */
  private document: PlanDocument | null = null;
  private layout: Layout | null = null;
  private box: Box = boxOf({ rooms: [] });
  private answer: Answer | null = null;
  private answeredPhoto: Photo | null = null;
  /** Index of the selected candidate. */
  private selected = 0;
  /** The marker's pose after the user moved it away from the candidate. */
  private moved: Pose | null = null;
  private query: AbortController | null = null;
  /** True once the user has chosen a plan, which the example must not replace. */
  private hasStarted = false;

  async start(): Promise<void> {
    connectKeyDialog();
    this.svg.append(
      this.editor.underlay.element,
      this.base,
      this.heat,
      this.localisability.element,
      this.names,
      this.hints.element,
      this.overlay,
      this.session.layer,
      ...this.editor.layers,
    );
    byId("edit-plan").addEventListener("click", () => this.edit(this.plan));
    byId("draw-plan").addEventListener("click", () => this.edit(null));
    this.find.addEventListener("click", () => void this.localise());
    connectGuide();
    showCursor(this.svg);
    connectSaveMap(this.svg, () => this.document?.name ?? "");
    byId("find-all").addEventListener("click", () => void this.localiseAll());
    addEventListener("hashchange", () => void this.open());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.drawAnswer());
    await this.panorama.setPicture(null);
    await device.start().catch((error: unknown) => showError(byId("photo-error"), error));
    const [stored] = await Promise.all([this.plans.load(), this.venues.load("")]);
    if (await this.open()) return;
    const example = await examplePlan(FLAT);
    // The user may have chosen a plan while the example was loading.
    if (this.hasStarted) return;
    const known = stored.find((plan) => plan.name === example.name);
    if (known !== undefined || stored.length === 0) {
      if (known === undefined) this.onExample(example);
      else await this.plans.choose(known.id);
      const files = await exampleFiles(FLAT);
      if (!this.hasStarted && this.photos.list.length === 0) this.photos.add(files);
    } else await this.plans.choose(stored[0]!.id);
  }

  /** React to the choice of a plan, venue or answer, which a running query would replace. */
  private onStarted(): void {
    this.hasStarted = true;
    this.cancelQuery();
  }

  private cancelQuery(): void {
    this.query?.abort();
    this.query = null;
    this.find.removeAttribute("aria-busy");
  }

  /** Show the answer or the session that the address names, if any. */
  private async open(): Promise<boolean> {
    const id = named("answer");
    if (id === null) return this.session.follow(named("session"));
    this.cancelQuery();
    clearError(byId("plan-error"));
    try {
      const answer = await api.answer(id);
      if (answer.venue_id != null) await this.venues.choose(answer.venue_id, null);
      else this.venues.leave();
      await this.plans.choose(answer.floorplan_id, answer.floorplan_revision);
      this.photos.choose(null);
      this.setAnswer(answer);
    } catch (error) {
      showError(byId("plan-error"), error);
    }
    return true;
  }

  private onExample(example: PlanDocument): void {
    this.document = example;
    this.hints.setRooms(
      example.rooms.map(({ name }, index) => ({ id: name ?? "", name: name ?? `room ${index + 1}` })),
    );
    byId("plan-name").textContent = example.name ?? "";
    byId("plan-facts").textContent = "example, stored with the first query";
    this.drawBase();
  }

  private onExamplePicked(plan: PlanDocument | null, photos: File[]): void {
    if (plan !== null) this.onExample(plan);
    const shown = this.photos.list.find(({ file }) => file.name === photos[0]?.name);
    if (shown === undefined) this.photos.add(photos);
    else this.photos.choose(shown);
  }

  private onVenue(venue: Venue | null): void {
    if (venue === null) this.cancelQuery();
    else this.onStarted();
    this.photos.offerGroups(venue === null);
    this.offerHints();
    this.photos.forgetHints();
    this.photos.forgetAnswers();
    this.hints.show(this.photos.current?.hints ?? null);
    this.setAnswer(null);
    if (venue !== null && venue.plans === 0) showError(byId("plan-error"), new InputError("This venue has no plans."));
  }

  private onPlan(plan: Plan | null): void {
    const isSame = plan !== null && plan.revision === this.plan?.revision;
    const isOther = plan === null || (this.plan !== null && this.plan.id !== plan.id);
    if (plan === null) this.cancelQuery();
    this.plan = plan;
    this.document = plan?.plan ?? null;
    byId("plan-name").textContent = plan?.name ?? "No plan chosen";
    byId("plan-facts").textContent =
      plan === null
        ? ""
        : `${plan.rooms.length} rooms, ${plan.area_m2.toFixed(1)} m², revision ${plan.revision_number}`;
    byId("preparing").hidden = plan?.status !== "preparing";
    byId<HTMLProgressElement>("plan-progress").value = plan?.progress ?? 0;
    if (plan?.status === "failed")
      showError(byId("plan-error"), new InputError(`The plan could not be prepared: ${plan.reason}`));
    showWarnings(plan);
    this.localisability.setPlan(plan);
    if (isSame) return;
    this.layout = null;
    this.photos.compass.setNorth(plan?.plan.north_deg ?? null);
    if (plan !== null && this.venues.current !== null) this.venues.mark(plan.id);
    else {
      this.photos.forgetAnswers();
      if (isOther) this.photos.forgetHints();
      this.setAnswer(null);
    }
    this.hints.setRooms(plan?.rooms ?? []);
    this.hints.show(this.photos.current?.hints ?? null);
    this.drawBase();
    this.drawAnswer();
    if (plan !== null) void this.loadLayout(plan);
  }

  private async loadLayout(plan: Plan): Promise<void> {
    try {
      const layout = await api.layout(plan.id, plan.revision);
      if (this.plan?.revision !== plan.revision) return;
      this.layout = layout;
      this.drawAnswer();
    } catch (error) {
      showError(byId("plan-error"), error);
    }
  }

  private drawBase(): void {
    const drawn: PlanDocument = this.document ?? { rooms: [] },
      lost = lostAreas(this.plan);
    this.box = boxOf(drawn, lost);
    this.viewport.fit(this.box);
    this.drawRooms(drawn, lost);
    this.session.drawOn(this.plan?.id, this.box);
    byId<HTMLButtonElement>("edit-plan").disabled = this.plan === null;
  }

  private drawRooms(plan: PlanDocument, lost: Point[][] = []): void {
    drawPlan(this.base, plan, lost);
    drawNames(this.names, plan, this.viewport.current, lost);
  }

  /** Redraw handles and names, whose size on the screen is constant. */
  private onViewChanged(): void {
    this.hints.draw(this.viewport.current);
    if (this.editor.isOpen) this.editor.redraw();
    else if (this.document !== null) drawNames(this.names, this.document, this.viewport.current, lostAreas(this.plan));
  }

  private edit(plan: Plan | null): void {
    this.onStarted();
    this.plans.discardPending();
    this.setAnswer(null);
    document.body.classList.add("editing");
    byId("plan-name").textContent = plan?.name ?? "New plan";
    this.editor.open(plan);
  }

  private onEdited(stored: Plan | null): void {
    document.body.classList.remove("editing");
    if (stored === null) {
      this.drawBase();
      byId("plan-name").textContent = this.document?.name ?? "No plan chosen";
      this.setAnswer(this.photos.current?.answer ?? null, this.photos.current);
    } else {
      this.photos.forgetAnswers();
      this.setAnswer(null);
      this.plans.take(stored);
      void this.plans.load();
    }
  }

  private onPhoto(photo: Photo | null, isOther: boolean): void {
    clearError(byId("photo-error"), this.fields);
    byId("photo-none").hidden = photo !== null;
    this.find.disabled = photo === null;
    if (isOther) this.hints.show(photo?.hints ?? null);
    if (isOther) {
      // A link shows an answer without its photograph; a photograph added to it is assumed to be the one.
      if (photo !== null && photo.answer === null && this.answer !== null && this.answeredPhoto === null)
        photo.answer = this.answer;
      void this.panorama
        .setPicture(photo?.file ?? null)
        .then(() => {
          this.panorama.setView(this.photos.current?.answer?.view ?? null);
          this.drawAnswer();
        })
        .catch((error: unknown) => {
          if (this.photos.current === photo) showError(byId("photo-error"), error);
        });
    }
    this.offerHints();
    this.setAnswer(photo?.answer ?? null, photo);
  }

  /** Sequences and venues are searched without hints. */
  private offerHints(): void {
    byId("hints").hidden = this.venues.current !== null || this.photos.group !== null;
  }

  private get fields(): Record<string, HTMLElement> {
    return { ...this.photos.fields, ...this.hints.fields };
  }

  private setAnswer(answer: Answer | null, photo: Photo | null = null): void {
    this.answer = answer;
    this.answeredPhoto = photo;
    this.selected = 0;
    this.moved = null;
    this.panorama.setView(photo === null ? null : (answer?.view ?? null));
    showAnswer(answer, photo, {
      select: (index) => this.select(index),
      save: (answered) => savePicture(answered, this.fields),
    });
    showAll(answer === null ? [] : this.photos.list, (chosen) => this.photos.choose(chosen));
    this.drawAnswer();
    if (answer === null) return;
    this.localisability.close();
    // The answer of a venue can lie in another plan than the one shown.
    this.select(0);
  }

  /** Draw the parts of the answer that lie in the plan shown. */
  private drawAnswer(): void {
    const { answer, document: drawn, plan } = this;
    const isHere = answer !== null && answer.floorplan_id === plan?.id;
    const posterior = isHere ? answer.posterior : null;
    byId("heat-legend").hidden = posterior === null;
    show(this.heat, posterior && drawn && heatMap(posterior, drawn));
    const hasFocus = this.marker.element.contains(document.activeElement);
    show(this.overlay);
    const candidate = answer?.candidates[this.selected];
    if (answer === null || drawn === null || candidate === undefined || candidate.floorplan_id !== plan?.id) {
      this.panorama.setLines([], 0);
      this.photos.compass.setFound(null);
      byId("fit-state").textContent = answer === null ? "" : "The selected place lies in another plan of the venue.";
      return;
    }
    show(
      this.overlay,
      isHere && ellipse(answer),
      companions(this.photos.list, this.answeredPhoto, plan.id, this.box, (photo) => this.photos.choose(photo)),
      otherPlaces(answer, plan.id, this.box, (index) => this.select(index)),
      this.marker.element,
    );
    if (hasFocus) this.marker.element.focus({ preventScroll: true });
    if (this.moved === null) this.select(this.selected);
    else this.drawLines(this.moved);
  }

  /** Move the marker to a candidate. */
  private select(index: number): void {
    const candidate = this.answer?.candidates[index];
    if (candidate === undefined) return;
    this.selected = index;
    this.moved = null;
    markSelected(index);
    if (candidate.floorplan_id !== this.plan?.id) {
      void this.plans.choose(candidate.floorplan_id);
      return;
    }
    const { x_m, y_m } = candidate.position;
    const pose = { x_m, y_m, heading_deg: candidate.heading_deg };
    this.marker.place(pose, this.box);
    this.drawLines(pose);
  }

  private onMoved(pose: Pose): void {
    markSelected(null);
    this.moved = pose;
    this.drawLines(pose);
  }

  private drawLines(pose: Pose): void {
    const state = byId("fit-state");
    this.photos.compass.setFound(pose.heading_deg);
    if (this.layout === null) return;
    const room = roomAt(this.layout.rooms, pose.x_m, pose.y_m);
    const height = this.answer?.camera_height_m ?? this.plan?.plan.camera_height_m ?? DEFAULT_CAMERA_HEIGHT_M;
    this.panorama.setLines(room === null ? [] : layoutLines(pose.x_m, pose.y_m, room, height), pose.heading_deg);
    const place = `x ${pose.x_m.toFixed(2)} m, y ${pose.y_m.toFixed(2)} m, heading ${pose.heading_deg.toFixed(0)}°`;
    state.textContent =
      room === null
        ? "The marker is in a wall or outside the plan: no layout."
        : this.answeredPhoto === null
          ? "Add the photograph to see the layout over it."
          : `Layout as seen from ${room.name}, ${place}.`;
  }

  private async localise(): Promise<void> {
    const photo = this.photos.current;
    if (photo === null) return;
    this.cancelQuery();
    const { signal } = (this.query = new AbortController());
    const { group } = this.photos;
    for (const asked of group?.photos ?? [photo]) asked.answer = null;
    this.setAnswer(null);
    clearError(byId("photo-error"), this.fields);
    this.find.setAttribute("aria-busy", "true");
    try {
      const place = this.venues.current ?? this.plan ?? (await this.storeExample(signal));
      if (signal.aborted) return;
      if (group === null) await askSingle(place, photo, signal);
      else await askTogether(place as Plan, group, signal);
      // The user may have chosen another plan in the meantime.
      if (signal.aborted || photo.answer === null) return;
      const { floorplan_id, floorplan_revision } = photo.answer;
      if (floorplan_revision !== this.plan?.revision) await this.plans.choose(floorplan_id, floorplan_revision);
      if (signal.aborted) return;
      const { current } = this.photos;
      if (current !== null && (current === photo || group !== null)) this.setAnswer(current.answer, current);
      this.photos.drawStrip();
      byId<HTMLDetailsElement>("settings").open = false;
      hideGuide();
      scrollTo(byId("answer"));
    } catch (error) {
      if (!signal.aborted) showError(byId("photo-error"), error, this.fields);
    } finally {
      if (!signal.aborted) this.cancelQuery();
    }
  }

  /** Localise all photographs in turn, up to the first error. */
  private async localiseAll(): Promise<void> {
    for (const photo of [...this.photos.list]) {
      this.photos.choose(photo);
      await this.localise();
      if (photo.answer === null) return;
    }
  }

  private async storeExample(signal?: AbortSignal): Promise<Plan> {
    if (this.document === null) throw new InputError("Choose or upload a floor plan first.");
    const plan = await api.createPlan(this.document);
    if (signal?.aborted !== true) this.plans.take(plan);
    await this.plans.load();
    return plan;
  }
}

void new Page().start();
