/** Scene of the plan: the floor plan with heat map, marker and other places of an answer, and the layers of other modules. */

import { companions, ellipse, otherPlaces, stepArrow } from "./answer_overlay";
import { byId, s, show } from "./dom";
import { heatMap } from "./heat";
import { LocalisabilityLayer } from "./localisability_layer";
import type { Photo } from "./photos";
import { connectSaveMap } from "./pictures";
import { type Box, boxOf, drawNames, drawPlan, lostAreas } from "./plan_drawing";
import { PoseMarker, showCursor } from "./pose_marker";
import type { Answer, Plan, PlanDocument, Point, Pose } from "./types";
import { Viewport } from "./viewport";

export interface SceneActions {
  /** Return the plan that is shown, stored if it is an example. */
  store: () => Promise<Plan>;
  /** Another part of the drawing is visible: handles and names, whose size on the screen is constant, are drawn again. */
  viewed: (visible: Box) => void;
  /** The user moved the marker. */
  moved: (pose: Pose) => void;
  /** The user clicked a candidate. */
  select: (index: number) => void;
  /** The user clicked the place of another photograph. */
  choose: (photo: Photo) => void;
}

export class PlanScene {
  readonly svg = byId("plan") as unknown as SVGSVGElement;
  readonly viewport = new Viewport(this.svg, this.svg.parentElement!, () => this.actions.viewed(this.viewport.current));
  readonly marker: PoseMarker;
  readonly localisability: LocalisabilityLayer;
  /** The plan that is shown; null for none, and for an example before it is stored. */
  plan: Plan | null = null;
  /** The drawn plan: a stored one, or the example before it is stored. */
  document: PlanDocument | null = null;
  /** Box around the drawn plan. */
  box: Box = boxOf({ rooms: [] });
  private readonly base = s("g");
  private readonly heat = s("g");
  private readonly names = s("g");
  private readonly overlay = s("g");

  constructor(private readonly actions: SceneActions) {
    this.localisability = new LocalisabilityLayer(actions.store);
    this.marker = new PoseMarker(this.svg, actions.moved);
    showCursor(this.svg);
    connectSaveMap(this.svg, () => this.document?.name ?? "");
  }

  /** Put the layers of other modules below, into and above the drawing. */
  arrange(below: Element, hints: Element, above: Element[]): void {
    const { base, heat, localisability, names, overlay } = this;
    this.svg.append(below, base, heat, localisability.element, names, hints, overlay, ...above);
  }

  /** Set the plan that is shown; `draw` draws it. */
  setPlan(plan: Plan | null, document: PlanDocument | null = plan?.plan ?? null): void {
    this.plan = plan;
    this.document = document;
    this.localisability.setPlan(plan);
  }

  /** Draw the plan and show all of it. */
  draw(): void {
    const plan: PlanDocument = this.document ?? { rooms: [] },
      lost = lostAreas(this.plan);
    this.box = boxOf(plan, lost);
    this.viewport.fit(this.box);
    this.drawRooms(plan, lost);
  }

  drawRooms(plan: PlanDocument, lost: Point[][] = []): void {
    drawPlan(this.base, plan, lost);
    drawNames(this.names, plan, this.viewport.current, lost);
  }

  drawNames(): void {
    if (this.document !== null) drawNames(this.names, this.document, this.viewport.current, lostAreas(this.plan));
  }

  /** Draw the parts of an answer that lie in the plan shown; return true if the selected candidate does. */
  drawAnswer(answer: Answer | null, selected: number, photo: Photo | null, photos: readonly Photo[]): boolean {
    const { plan, document: drawn, box, actions } = this;
    const isHere = answer !== null && answer.floorplan_id === plan?.id;
    const posterior = isHere ? answer.posterior : null;
    byId("heat-legend").hidden = posterior === null;
    show(this.heat, posterior && drawn && heatMap(posterior, drawn, answer!));
    const hasFocus = this.marker.element.contains(document.activeElement);
    show(this.overlay);
    if (answer === null || plan === null || answer.candidates[selected]?.floorplan_id !== plan.id) return false;
    show(
      this.overlay,
      isHere && ellipse(answer),
      isHere && selected === 0 && stepArrow(answer, box),
      companions(photos, photo, plan.id, box, actions.choose),
      otherPlaces(answer, plan.id, box, actions.select),
      this.marker.element,
    );
    if (hasFocus) this.marker.element.focus({ preventScroll: true });
    return true;
  }
}
