/** Camera marker on the plan, moved with pointer or keyboard. */

import { ARROWS, byId, followPointer, s } from "./dom";
import { degrees, radians } from "./layout";
import { type Box, unitOf } from "./plan_drawing";
import type { Point, Pose } from "./types";

const STEP_M = 0.05;
const FAR_STEP_M = 0.5;
const TURN_DEG = 2;

/** Return the point of a drawing under the pointer, in the drawing's units. */
export function placeOf(svg: SVGSVGElement, event: PointerEvent | MouseEvent): Point {
  const matrix = svg.getScreenCTM();
  if (matrix === null) return [0, 0];
  const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix.inverse());
  return [x, -y];
}

/** Show the coordinates under the pointer beside the name of the plan. */
export function showCursor(svg: SVGSVGElement): void {
  const text = byId("cursor");
  svg.addEventListener("pointermove", (event) => {
    const [x, y] = placeOf(svg, event);
    text.textContent = `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m`;
  });
  svg.addEventListener("pointerleave", () => {
    text.textContent = "";
  });
}

export class PoseMarker {
  readonly element: SVGGElement;
  private readonly cone = s("path", { class: "cone" });
  private readonly arrow = s("path", { class: "arrow" });
  private readonly knob = s("circle", { class: "turn" });
  private pose: Pose = { x_m: 0, y_m: 0, heading_deg: 0 };
  private view = { yaw: 0, fov: 1.5 };
  private unit = 0.1;

  constructor(
    private readonly svg: SVGSVGElement,
    private readonly moved: (pose: Pose) => void,
  ) {
    const dot = s("circle", { class: "dot", r: 1 });
    this.element = s(
      "g",
      {
        class: "marker",
        tabindex: 0,
        role: "application",
        id: "marker",
        "aria-label": "Camera on the plan. Arrow keys move it, with Shift in large steps; comma and full stop turn it.",
      },
      this.cone,
      this.arrow,
      this.knob,
      s("circle", { class: "grip", r: 1 }),
      dot,
    );
    this.follow(this.element.querySelector(".grip")!, ([x, y]) => ({ ...this.pose, x_m: x, y_m: y }));
    this.follow(dot, ([x, y]) => ({ ...this.pose, x_m: x, y_m: y }));
    this.follow(this.knob, ([x, y]) => {
      const azimuth = degrees(Math.atan2(x - this.pose.x_m, y - this.pose.y_m));
      return { ...this.pose, heading_deg: (azimuth + 360) % 360 };
    });
    this.element.addEventListener("keydown", (event) => this.onKey(event));
  }

  /** Set the pose without calling the listener. */
  place(pose: Pose, box: Box): void {
    this.pose = pose;
    this.unit = unitOf(box);
    this.draw();
  }

  /** Show the visible part of the photograph: yaw from its centre and field of view, radians. */
  look(yaw: number, fov: number): void {
    this.view = { yaw, fov };
    this.draw();
  }

  private draw(): void {
    const unit = this.unit,
      { x_m, y_m, heading_deg } = this.pose;
    this.element.setAttribute("transform", `translate(${x_m} ${-y_m})`);
    this.element.querySelector(".dot")!.setAttribute("r", String(1.1 * unit));
    this.element.querySelector(".grip")!.setAttribute("r", String(2.6 * unit));
    const tip = (azimuth: number, length: number): string =>
      `${(length * Math.sin(azimuth)).toFixed(4)} ${(-length * Math.cos(azimuth)).toFixed(4)}`;
    const heading = radians(heading_deg),
      middle = heading + this.view.yaw,
      half = 0.5 * Math.min(this.view.fov, 6.2);
    // A view all around has no direction.
    this.cone.classList.toggle("none", this.view.fov > Math.PI);
    const far = 16 * unit,
      large = half > Math.PI / 2 ? 1 : 0;
    this.cone.setAttribute(
      "d",
      `M0 0L${tip(middle - half, far)}A${far} ${far} 0 ${large} 1 ${tip(middle + half, far)}Z`,
    );
    this.arrow.setAttribute("d", `M${tip(heading, 1.1 * unit)}L${tip(heading, 6.4 * unit)}`);
    const [knobX, knobY] = tip(heading, 7.2 * unit).split(" ");
    this.knob.setAttribute("cx", knobX!);
    this.knob.setAttribute("cy", knobY!);
    this.knob.setAttribute("r", String(1.1 * unit));
  }

  private move(pose: Pose): void {
    this.pose = pose;
    this.draw();
    this.moved(pose);
  }

  private follow(handle: Element, poseAt: (place: Point) => Pose): void {
    handle.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      event.stopPropagation();
      this.element.focus();
      followPointer((moving) => this.move(poseAt(placeOf(this.svg, moving))));
    });
  }

  private onKey(event: KeyboardEvent): void {
    const step = event.shiftKey ? FAR_STEP_M : STEP_M;
    const turns: Record<string, number> = { ",": -TURN_DEG, ".": TURN_DEG };
    const arrow = ARROWS[event.key],
      turned = turns[event.key];
    if (arrow === undefined && turned === undefined) return;
    event.preventDefault();
    const { x_m, y_m, heading_deg } = this.pose,
      [dx, dy] = arrow ?? [0, 0];
    this.move({ x_m: x_m + step * dx, y_m: y_m + step * dy, heading_deg: (heading_deg + (turned ?? 0) + 360) % 360 });
  }
}
