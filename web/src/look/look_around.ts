/** “Look around”: the rear camera takes the photographs of a turn by itself, and shows the plan's lines afterwards. */

import { button, byId } from "../dom";
import { acceptChoice } from "../drops";
import { clearError, showError } from "../notices";
import { FrameJudge, takeFrame } from "./frames";
import { drawLive, type LiveAnswer } from "./live_lines";
import { Orientation } from "./orientation";
import { Ring } from "./ring";
import { type Hint, HINTS, Turn } from "./turn";

const TICK_MS = 120,
  LEAST_FRAMES = 2;

const REFUSED =
  "The motion sensors are not allowed, so the photographs tell the angles by overlap. Safari asks once only: load the page again to be asked.";

export interface Finder {
  /** Find the place of frames, with their directions (degrees) if a gyroscope told them; null if it was stopped. */
  findTurn(frames: File[], directions: number[] | null, signal: AbortSignal): Promise<FoundPlace | null>;
  findFilm(film: File, signal: AbortSignal): Promise<boolean>;
}

/** Answer in words, and for the live picture; null until the walls of its plan are loaded. */
export interface FoundPlace {
  words: string;
  live: () => LiveAnswer | null;
}

/** Dialog with the camera's picture. */
export class LookAround {
  private readonly dialog = byId<HTMLDialogElement>("look-dialog");
  private readonly stage = byId("look-stage");
  private readonly video = byId<HTMLVideoElement>("look-video");
  private readonly lines = byId<HTMLCanvasElement>("look-lines");
  private readonly ring = new Ring();
  private readonly hint = byId("look-hint");
  private readonly error = byId("look-error");
  private readonly film = byId<HTMLInputElement>("look-film");
  private readonly instead = byId("look-instead");
  private readonly find = button("Find the place", () => void this.localise(), { class: "primary", disabled: true });
  private readonly take = button("Take a photograph", () => void this.takeNow());
  private readonly sensors = button("Allow motion sensors", () => void this.askAgain(), { hidden: true });
  private readonly close = button("Cancel", () => this.dialog.close());
  private readonly orientation = new Orientation();
  private stream: MediaStream | null = null;
  private judge = new FrameJudge();
  private turn = new Turn();
  private frames: File[] = [];
  private state: "off" | "looking" | "finding" | "found" = "off";
  private found: FoundPlace | null = null;
  private live: LiveAnswer | null = null;
  private query: AbortController | null = null;
  private timer: number | undefined;
  private before = 0;
  private said: Hint | null = null;
  private isTaking = false;

  constructor(private readonly finder: Finder) {
    this.stage.append(this.ring.element);
    byId("look-ask").append(this.find, this.take, this.sensors, this.close);
    this.dialog.addEventListener("close", () => this.stop());
    acceptChoice(this.film, ([film]) => void this.localiseFilm(film!));
    // The camera's light goes out when the page is left, too.
    addEventListener("pagehide", () => this.dialog.close());
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState === "hidden" && this.stream !== null) this.dialog.close();
    });
  }

  async open(): Promise<void> {
    this.begin();
    this.found = this.live = null;
    clearError(this.error);
    this.lines.getContext("2d")?.clearRect(0, 0, this.lines.width, this.lines.height);
    this.close.textContent = "Cancel";
    this.find.hidden = this.take.hidden = false;
    this.sensors.hidden = true;
    this.dialog.showModal();
    // iOS asks for both permissions within the click.
    const sensors = this.orientation.start();
    try {
      this.stream = await rearCamera();
      if (!this.dialog.open) return this.stop();
      this.video.srcObject = this.stream;
      await this.video.play();
    } catch (error) {
      return this.offerFilm(reasonOf(error));
    }
    await sensors;
    this.sensors.hidden = !this.orientation.isDenied;
    this.instead.hidden = true;
    this.stage.hidden = false;
    this.state = "looking";
    this.timer = window.setInterval(() => void this.tick(), TICK_MS);
  }

  /** Begin a turn without photographs. */
  private begin(): void {
    this.frames = [];
    this.turn = new Turn();
    this.judge = new FrameJudge();
    this.said = null;
    this.before = 0;
    this.find.textContent = "Find the place";
    this.find.disabled = true;
    this.ring.show([], 0, 0);
  }

  /** Ask for the sensors once more; with them, the turn begins anew, so that they tell all of its directions. */
  private async askAgain(): Promise<void> {
    await this.orientation.start();
    this.sensors.hidden = !this.orientation.isDenied;
    if (this.orientation.attitude === null && this.orientation.isDenied) showError(this.error, new Error(REFUSED));
    else clearError(this.error);
    if (this.state === "looking" && this.orientation.attitude !== null) this.begin();
  }

  /** Say why there is no camera, and offer to choose a film. */
  private offerFilm(reason: string): void {
    this.stop();
    if (!this.dialog.open) return;
    this.stage.hidden = this.find.hidden = this.take.hidden = this.sensors.hidden = true;
    this.instead.hidden = false;
    this.hint.textContent = reason;
    this.film.focus();
  }

  private stop(): void {
    clearInterval(this.timer);
    this.query?.abort();
    this.query = null;
    this.orientation.stop();
    for (const track of this.stream?.getTracks() ?? []) track.stop();
    this.stream = this.video.srcObject = null;
    this.state = "off";
  }

  private async tick(): Promise<void> {
    if (this.video.videoWidth === 0) return;
    const now = performance.now() / 1000,
      passed = this.before === 0 ? 0 : now - this.before;
    this.before = now;
    const { attitude, isWalking } = this.orientation;
    const judged = this.judge.judge(this.video),
      isUpright = this.video.videoHeight >= this.video.videoWidth;
    const hint = this.turn.follow({ judged, attitude, isWalking, passed, isUpright });
    this.ring.show(this.turn.taken, this.turn.halfStep, this.turn.yaw);
    if (this.state === "found") {
      this.live ??= this.found?.live() ?? null;
      if (this.live !== null)
        drawLive(this.lines, this.video, this.live, this.turn.yaw - (this.turn.taken[0] ?? 0), attitude);
    }
    if (this.state !== "looking") return;
    if (hint !== this.said) this.hint.textContent = HINTS[(this.said = hint)];
    if (hint === "done") await this.localise();
    else if (this.turn.wants(hint)) await this.takeNow();
  }

  private async takeNow(): Promise<void> {
    if (this.isTaking || this.state !== "looking" || this.video.videoWidth === 0) return;
    this.isTaking = true;
    try {
      this.turn.take(this.orientation.attitude);
      const number = String(this.turn.taken.length).padStart(2, "0");
      this.frames.push(await takeFrame(this.video, `turn-${number}.jpg`));
      this.find.disabled = this.frames.length < LEAST_FRAMES;
      this.find.textContent = `Find the place (${this.frames.length} photographs)`;
    } catch (error) {
      this.turn.taken.length = this.frames.length;
      showError(this.error, error);
    } finally {
      this.isTaking = false;
    }
  }

  private async localise(): Promise<void> {
    if (this.state !== "looking" || this.frames.length < LEAST_FRAMES || this.isTaking) return;
    this.state = "finding";
    this.find.disabled = this.take.disabled = true;
    this.hint.textContent = `Finding the place of ${this.frames.length} photographs…`;
    const { signal } = (this.query = new AbortController());
    try {
      const directions = this.turn.hasGyroscope ? this.turn.taken.map((yaw) => yaw - this.turn.taken[0]!) : null;
      const found = await this.finder.findTurn(this.frames, directions, signal);
      if (found === null || signal.aborted) return;
      this.state = "found";
      this.found = found;
      this.hint.textContent = found.words;
      this.find.hidden = this.take.hidden = this.sensors.hidden = true;
      this.close.textContent = "Show on the plan";
      this.close.focus();
    } catch (error) {
      if (signal.aborted) return;
      this.state = "looking";
      showError(this.error, error);
    } finally {
      this.find.disabled = this.take.disabled = false;
    }
  }

  private async localiseFilm(film: File): Promise<void> {
    clearError(this.error);
    this.hint.textContent = `Reading “${film.name}”…`;
    const { signal } = (this.query = new AbortController());
    try {
      if (await this.finder.findFilm(film, signal)) this.dialog.close();
    } catch (error) {
      if (signal.aborted) return;
      this.hint.textContent = "";
      showError(this.error, error);
    }
  }
}

async function rearCamera(): Promise<MediaStream> {
  // Browsers hide cameras from pages without HTTPS.
  if ((navigator.mediaDevices as MediaDevices | undefined) === undefined) throw new DOMException("", "SecurityError");
  return navigator.mediaDevices.getUserMedia({
    audio: false,
    video: { facingMode: { ideal: "environment" }, width: { ideal: 1920 }, height: { ideal: 1080 } },
  });
}

/** Say why there is no camera. */
function reasonOf(error: unknown): string {
  const name = error instanceof DOMException ? error.name : "";
  if (name === "SecurityError")
    return "Browsers allow the camera on HTTPS pages only, and this page was loaded without. A film works as well.";
  if (name === "NotAllowedError")
    return "The browser was not allowed to use the camera. Allow it in the page's settings, or send a film.";
  if (name === "NotFoundError" || name === "OverconstrainedError")
    return "This device has no camera that the browser can use. A film works as well.";
  return `The camera did not start${error instanceof Error ? `: ${error.message}` : ""}. A film works as well.`;
}
