/** Controller of the answer: photographs with hints become a query, and its answer is shown in all panels. */

import { showAll } from "./all_answers";
import { markSelected, showAnswer } from "./answer_panel";
import { captionWords, confidenceWords, stepWords } from "./answer_words";
import { api } from "./api";
import { device } from "./device/device";
import { byId, scrollTo } from "./dom";
import { hideGuide } from "./guide";
import { HintForm } from "./hints";
import { layoutLines, roomAt } from "./layout";
import type { LiveAnswer } from "./look/live_lines";
import type { FoundPlace } from "./look/look_around";
import { attempt, clearError, clearErrors, showError } from "./notices";
import { PhotoView } from "./photo_view";
import { type Photo, Photos } from "./photos";
import { savePicture } from "./pictures";
import type { PlanScene } from "./plan_scene";
import { askFilm, askSingle, askTogether, type Place } from "./query";
import type { Answer, ChosenVenue, Layout, Plan, Pose } from "./types";

const DEFAULT_CAMERA_HEIGHT_M = 1.5;

export interface ControllerActions {
  /** Return the plan or venue to search; an example is stored first. */
  place: (signal: AbortSignal) => Promise<Place>;
  /** Show a plan, by default its current revision. */
  showPlan: (id: string, revision?: string) => Promise<unknown>;
}

export class AnswerController {
  readonly photos = new Photos((photo, isOther) => this.onPhoto(photo, isOther));
  readonly hints: HintForm;
  private readonly photoView = new PhotoView(byId("photo-view"), (yaw, fov) => this.scene.marker.look(yaw, fov));
  private readonly find = byId<HTMLButtonElement>("find");
  private readonly error = byId("photo-error");
  private layout: Layout | null = null;
  private venue: ChosenVenue | null = null;
  private answer: Answer | null = null;
  private answeredPhoto: Photo | null = null;
  private selected = 0;
  /** The marker's pose after the user moved it away from the candidate. */
  private moved: Pose | null = null;
  private query: AbortController | null = null;

  constructor(
    private readonly scene: PlanScene,
    private readonly actions: ControllerActions,
  ) {
    this.hints = new HintForm(scene.svg, (hints) => this.photos.setHints(hints));
    this.find.addEventListener("click", () => void this.localise());
    byId("find-all").addEventListener("click", () => void this.localiseAll());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  async start(): Promise<void> {
    await this.photoView.setPicture(null);
    await device.start().catch((error: unknown) => showError(this.error, error));
  }

  cancelQuery(): void {
    this.query?.abort();
    this.query = null;
    this.find.removeAttribute("aria-busy");
  }

  /** Search the plans of a venue; null: a single plan. */
  setVenue(venue: ChosenVenue | null): void {
    this.venue = venue;
    this.forget(true);
    this.offerHints();
  }

  /** Show photographs and answer with another plan, which the scene has drawn. */
  setPlan(plan: Plan | null): void {
    this.layout = null;
    this.photos.compass.setNorth(plan?.plan.north_deg ?? null);
    this.offerHints();
    this.draw();
    if (plan !== null) void this.loadLayout(plan);
  }

  private async loadLayout(plan: Plan): Promise<void> {
    try {
      const layout = await api.layout(plan.id, plan.revision);
      if (this.scene.plan?.revision !== plan.revision) return;
      this.layout = layout;
      this.draw();
    } catch (error) {
      showError(byId("plan-error"), error);
    }
  }

  /** Remove all answers, which belong to one plan or venue, and on demand all hints. */
  forget(hints: boolean): void {
    this.photos.forgetAnswers();
    if (hints) this.photos.forgetHints();
    this.hints.show(this.photos.current?.hints ?? null);
    this.show(null);
  }

  private onPhoto(photo: Photo | null, isOther: boolean): void {
    clearError(this.error, this.fields);
    byId("photo-none").hidden = photo !== null;
    this.find.disabled = photo === null;
    if (isOther) {
      this.hints.show(photo?.hints ?? null);
      // A link shows an answer without its photograph; a photograph added to it is assumed to be the one.
      if (photo !== null && photo.answer === null && this.answer !== null && this.answeredPhoto === null)
        photo.answer = this.answer;
      void this.photoView
        .setPicture(photo?.file ?? null)
        .then(() => {
          this.photoView.setView(this.photos.current?.answer?.view ?? null);
          this.draw();
        })
        .catch((error: unknown) => {
          if (this.photos.current === photo) showError(this.error, error);
        });
    }
    // Sequences are searched without hints.
    byId("hints").hidden = this.photos.group !== null;
    this.show(photo?.answer ?? null, photo);
  }

  /** Offer hints about the plan that the scene shows, or about the venue. */
  offerHints(): void {
    this.hints.offer(this.scene.plan, this.scene.document, this.venue);
  }

  private get fields(): Record<string, HTMLElement> {
    return { ...this.photos.fields, ...this.hints.fields };
  }

  /** Show an answer, by default without its photograph; null removes the previous one. */
  show(answer: Answer | null, photo: Photo | null = null): void {
    this.answer = answer;
    this.answeredPhoto = photo;
    this.selected = 0;
    this.moved = null;
    this.photoView.setView(photo === null ? null : (answer?.view ?? null));
    showAnswer(answer, photo, {
      select: (index) => this.select(index),
      save: (shown, answered) => {
        // An answer that a link opened has no photograph until one is added.
        const name = answered?.file.name ?? "answer";
        const save = () => savePicture(name, this.photoView.toCanvas(), this.scene.svg, captionWords(shown));
        return attempt(this.error, save, this.fields);
      },
    });
    showAll(answer === null ? [] : this.photos.list, (chosen) => this.photos.choose(chosen));
    this.draw();
    if (answer === null) return;
    this.scene.localisability.close();
    // The answer of a venue can lie in another plan than the one shown.
    this.select(0);
  }

  /** Show the answer of the chosen photograph again. */
  restore(): void {
    this.show(this.photos.current?.answer ?? null, this.photos.current);
  }

  private draw(): void {
    if (!this.scene.drawAnswer(this.answer, this.selected, this.answeredPhoto, this.photos.list)) {
      this.photoView.setLines([], 0);
      this.photos.compass.setFound(null);
      byId("fit-state").textContent =
        this.answer === null ? "" : "The selected place lies in another plan of the venue.";
    } else if (this.moved === null) this.select(this.selected);
    else this.drawLines(this.moved);
  }

  /** Move the marker to a candidate. */
  select(index: number): void {
    const candidate = this.answer?.candidates[index];
    if (candidate === undefined) return;
    this.selected = index;
    this.moved = null;
    markSelected(index);
    if (candidate.floorplan_id !== this.scene.plan?.id) return void this.actions.showPlan(candidate.floorplan_id);
    const pose: Pose = { ...candidate.position, heading_deg: candidate.heading_deg };
    this.scene.marker.place(pose, this.scene.box);
    this.drawLines(pose);
  }

  /** Show the layout from the pose that the user gave the marker. */
  move(pose: Pose): void {
    markSelected(null);
    this.moved = pose;
    this.drawLines(pose);
  }

  private drawLines(pose: Pose): void {
    this.photos.compass.setFound(pose.heading_deg);
    if (this.layout === null) return;
    const room = roomAt(this.layout.rooms, pose.x_m, pose.y_m);
    const height = this.answer?.camera_height_m ?? this.scene.plan?.plan.camera_height_m ?? DEFAULT_CAMERA_HEIGHT_M;
    this.photoView.setLines(room === null ? [] : layoutLines(pose.x_m, pose.y_m, room, height), pose.heading_deg);
    const place = `x ${pose.x_m.toFixed(2)} m, y ${pose.y_m.toFixed(2)} m, heading ${pose.heading_deg.toFixed(0)}°`;
    byId("fit-state").textContent =
      room === null
        ? "The marker is in a wall or outside the plan: no layout."
        : this.answeredPhoto === null
          ? "Add the photograph to see the layout over it."
          : `Layout as seen from ${room.name}, ${place}.`;
  }

  /** Localise the chosen photograph, or its group, and show errors. */
  private localise(): Promise<void> {
    return attempt(this.error, () => this.search(), this.fields);
  }

  /** Localise the frames of a guided turn; null if it was stopped. */
  async findTurn(frames: File[], directions: number[] | null, signal: AbortSignal): Promise<FoundPlace | null> {
    this.photos.takeTurn(frames, directions);
    signal.addEventListener("abort", () => this.cancelQuery());
    await this.search();
    const { answer } = this;
    if (answer === null || signal.aborted) return null;
    const words = `${answer.room}. ${confidenceWords(answer.confidence)}. ${stepWords(answer) ?? ""}`;
    return { words, live: () => this.liveAnswer(answer) };
  }

  /** Localise a film of a turn; return false if it was stopped. */
  async findFilm(film: File, signal: AbortSignal): Promise<boolean> {
    const answer = await askFilm(await this.actions.place(signal), film, signal);
    if (signal.aborted) return false;
    if (answer.floorplan_id !== this.scene.plan?.id) await this.actions.showPlan(answer.floorplan_id);
    this.photos.choose(null);
    this.show(answer);
    scrollTo(byId("answer"));
    return true;
  }

  /** Return an answer for the live picture; null before its plan's walls are loaded. */
  private liveAnswer({ view, position: { x_m, y_m }, heading_deg, camera_height_m }: Answer): LiveAnswer | null {
    const room = this.layout === null ? null : roomAt(this.layout.rooms, x_m, y_m);
    if (room === null || view == null) return null;
    return { view, heading: heading_deg, lines: layoutLines(x_m, y_m, room, camera_height_m) };
  }

  /** Localise the chosen photograph, or its group. Rejects with the error, unless it was stopped. */
  private async search(): Promise<void> {
    const photo = this.photos.current;
    if (photo === null) return;
    this.cancelQuery();
    const { signal } = (this.query = new AbortController());
    const { group } = this.photos;
    for (const asked of group ?? [photo]) asked.answer = null;
    this.show(null);
    clearError(this.error, this.fields);
    this.find.setAttribute("aria-busy", "true");
    try {
      const place = await this.actions.place(signal);
      if (signal.aborted) return;
      if (group === null) await askSingle(place, photo, signal);
      else await askTogether(place, group, signal);
      // The user may have chosen another plan in the meantime.
      if (signal.aborted || photo.answer === null) return;
      clearErrors();
      const { floorplan_id, floorplan_revision } = photo.answer;
      if (floorplan_revision !== undefined && floorplan_revision !== this.scene.plan?.revision)
        await this.actions.showPlan(floorplan_id, floorplan_revision);
      if (signal.aborted) return;
      const { current } = this.photos;
      if (current !== null && (current === photo || group !== null)) this.show(current.answer, current);
      this.photos.drawStrip();
      byId<HTMLDetailsElement>("settings").open = false;
      hideGuide();
      scrollTo(byId("answer"));
    } catch (error) {
      if (!signal.aborted) throw error;
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
}
