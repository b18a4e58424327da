/** Live session: a camera that is followed from photograph to photograph, by this page or by another client. */

import { pause } from "../../clients/typescript/src/transport";
import { ellipse } from "./answer_overlay";
import { api, ServiceError } from "./api";
import { device } from "./device/device";
import { button, byId, h, s, show } from "./dom";
import { acceptChoice } from "./drops";
import { attempt } from "./notices";
import { percent } from "./plain_words";
import { type Box, unitOf } from "./plan_drawing";
import type { Plan, Session, Venue } from "./types";

const POLL_MS = 2000;
// A photograph of a service that was stopped hard blocks its session for up to 15 s.
const BUSY_TRIES = 20;
// Other places below this probability are not shown.
const MIN_SHARE = 0.01;
const MODES: Record<Session["mode"], string> = {
  searching: "Searching: several places are possible. Walk a few steps and add another photograph.",
  tracking: "Following the camera: its place is known.",
  lost: "Lost: the latest photographs do not fit the plan.",
};

export interface SessionActions {
  /** Return the plan or venue to follow a camera in. */
  place: () => Promise<Plan | Venue>;
  /** Show a plan of the session. */
  showPlan: (planId: string) => void;
  /** A session begins to be shown: answers to single photographs are hidden. */
  opened: () => void;
}

/** Panel and layer on the plan of a session. */
export class LiveSession {
  readonly layer = s("g", { class: "session" });
  private readonly state = h("div", { "aria-live": "polite" });
  private readonly error = h("div", { class: "error", id: "session-error", role: "alert", hidden: true });
  private readonly input = h("input", {
    type: "file",
    id: "session-file",
    accept: byId<HTMLInputElement>("photo-file").accept,
    multiple: true,
  });
  private readonly begin = button("Follow a camera here", () => void this.start(), { id: "session-start" });
  private readonly next = h("label", { class: "file" }, this.input, h("span", {}, "Add the next photo"));
  private readonly stop = button("Stop", () => void this.end(), { id: "session-stop" });
  private session: Session | null = null;
  /** True for a session that this page began, and deletes at its end. */
  private isOwn = false;
  private sending = false;
  private plan: { id: string | undefined; box: Box } = { id: undefined, box: { x: 0, y: 0, width: 1, height: 1 } };

  constructor(private readonly actions: SessionActions) {
    acceptChoice(this.input, (files) => void this.add(files));
    byId("session").append(
      h("div", { class: "session-bar" }, this.begin, this.next, this.stop),
      this.error,
      this.state,
    );
    this.draw();
  }

  /** Draw the parts that lie in the plan shown. */
  drawOn(planId: string | undefined, box: Box): void {
    this.plan = { id: planId, box };
    this.draw();
  }

  /** Follow a session that another client feeds; return false without an id. */
  async follow(id: string | null): Promise<boolean> {
    if (id !== null && id !== this.session?.id)
      await attempt(this.error, async () => this.open(await api.session(id), false));
    return id !== null;
  }

  private async start(): Promise<void> {
    await attempt(this.error, async () => {
      const place = await this.actions.place();
      this.open(await api.createSession("plans" in place ? { venue_id: place.id } : { floorplan_id: place.id }), true);
      history.replaceState(null, "", `#session=${this.session!.id}`);
    });
  }

  private open(session: Session, isOwn: boolean): void {
    byId<HTMLDetailsElement>("follow").open = true;
    this.actions.opened();
    this.isOwn = isOwn;
    this.take(session);
    void this.poll(session.id);
  }

  /** Ask for the state of the session until it ends. */
  private async poll(id: string): Promise<void> {
    while (this.session?.id === id) {
      await pause(POLL_MS);
      if (document.hidden || this.sending || this.session?.id !== id) continue;
      try {
        const session = await api.session(id);
        if (this.session?.id === id && session.photographs !== this.session.photographs) this.take(session);
      } catch (error) {
        // Without an answer, the next attempt can have one.
        if (this.session?.id !== id || !(error instanceof ServiceError) || error.status !== 404) continue;
        this.close();
        show(this.state, h("p", {}, "The session has ended."));
      }
    }
  }

  private async add(files: File[]): Promise<void> {
    const id = this.session?.id;
    this.sending = true;
    this.next.setAttribute("aria-busy", "true");
    await attempt(this.error, async () => {
      for (const file of files) {
        if (this.session?.id !== id) return;
        const session = await this.sent(file);
        if (this.session?.id === id) this.take(session);
      }
    });
    this.sending = false;
    this.next.removeAttribute("aria-busy");
  }

  private async sent(file: File): Promise<Session> {
    for (let tries = 1; ; tries++) {
      try {
        return await device.send([file], { number: String(this.session!.photographs + 1) }, ([picture], fields) =>
          api.addPhotograph(this.session!.id, fields, picture!),
        );
      } catch (error) {
        const isBusy = error instanceof ServiceError && error.slug === "session-busy";
        if (!isBusy || tries === BUSY_TRIES || this.session === null) throw error;
        await pause(1000 * (error.retryAfterS ?? 1));
      }
    }
  }

  private async end(): Promise<void> {
    const { session, isOwn } = this;
    this.close();
    if (session !== null && isOwn) await attempt(this.error, () => api.deleteSession(session.id));
  }

  private close(): void {
    this.session = null;
    history.replaceState(null, "", location.pathname);
    show(this.state);
    this.draw();
  }

  private take(session: Session): void {
    this.session = session;
    this.describe(session);
    const planId = session.pose?.floorplan_id ?? session.floorplan_id;
    if (planId && planId !== this.plan.id) this.actions.showPlan(planId);
    this.draw();
  }

  private describe({ mode, pose, photographs, id }: Session): void {
    const others = (pose?.candidates ?? []).slice(1).filter(({ probability }) => probability >= MIN_SHARE);
    const level = (at: { level?: number | null }): string => (at.level == null ? "" : `, level ${at.level}`);
    const possible = others.map((at) => `${at.room}${level(at)} (${percent(at.probability)})`);
    show(
      this.state,
      h("p", { id: "session-mode", class: `mode ${mode}` }, pose === null ? "Add the first photograph." : MODES[mode]),
      pose !== null &&
        h(
          "p",
          { id: "session-pose" },
          h("strong", {}, `${pose.room}${level(pose)}`),
          ` ${percent(pose.probability)} probable, after ${photographs} ${photographs === 1 ? "photograph" : "photographs"}`,
        ),
      possible.length > 0 && h("p", { class: "hint" }, `Also possible: ${possible.join(", ")}`),
      ...(pose?.warnings ?? []).map((warning) => h("p", { class: "hint" }, warning)),
      h("p", { class: "hint" }, "Others can watch at ", h("a", { href: `#session=${id}` }, "this address"), "."),
    );
  }

  private draw(): void {
    const { session } = this;
    this.begin.hidden = session !== null;
    this.next.hidden = this.stop.hidden = session === null;
    const { id, box } = this.plan,
      unit = unitOf(box),
      pose = session?.pose ?? null;
    if (session === null || pose === null || id === undefined) return show(this.layer);
    const isHere = (at: { floorplan_id?: string | null }): boolean => (at.floorplan_id ?? session.floorplan_id) === id;
    const path = session.path.filter(isHere).map(({ position }) => position);
    const { x_m, y_m } = pose.position;
    show(
      this.layer,
      s("path", {
        class: "track",
        d: path.map(({ x_m: x, y_m: y }, index) => `${index === 0 ? "M" : "L"}${x} ${-y}`).join(""),
      }),
      ...path.map(({ x_m: x, y_m: y }) => s("circle", { class: "step", cx: x, cy: -y, r: 0.5 * unit })),
      ...pose.candidates
        .slice(1)
        .filter((rival) => rival.probability >= MIN_SHARE && isHere(rival))
        .map((rival) =>
          s(
            "circle",
            { class: "rival-place", cx: rival.position.x_m, cy: -rival.position.y_m, r: 1.4 * unit },
            s("title", {}, `${rival.room}, ${percent(rival.probability)} probable`),
          ),
        ),
      isHere(pose) && ellipse({ position: pose.position, covariance_m2: pose.covariance }),
      isHere(pose) &&
        s(
          "g",
          {
            class: `camera ${session.mode}`,
            id: "session-camera",
            transform: `translate(${x_m} ${-y_m}) rotate(${pose.heading_deg})`,
          },
          s("title", {}, `Camera in ${pose.room}`),
          s("path", { d: `M0 ${-4.5 * unit}L${1.1 * unit} 0H${-1.1 * unit}Z` }),
          s("circle", { r: 1.3 * unit }),
        ),
    );
  }
}
