/** Ring that fills as one turns, with a needle where the camera looks. */

import { s } from "../dom";
import { radians } from "../layout";

const RADIUS = 42;

export class Ring {
  private readonly parts = s("g");
  private readonly needle = s("path", { class: "needle", d: `M0 ${-RADIUS + 9}L0 ${-RADIUS - 6}` });
  readonly element = s(
    "svg",
    { class: "ring", viewBox: "-50 -50 100 100", role: "img", "aria-label": "Turned by 0 %" },
    s("circle", { class: "all", r: RADIUS }),
    this.parts,
    this.needle,
  );

  /** Show the directions (degrees) of frames, each with half the angle that it fills, and of the camera. */
  show(taken: readonly number[], half: number, yaw: number): void {
    const at = (degrees: number): string =>
      `${(RADIUS * Math.sin(radians(degrees))).toFixed(2)} ${(-RADIUS * Math.cos(radians(degrees))).toFixed(2)}`;
    this.needle.setAttribute("transform", `rotate(${yaw.toFixed(1)})`);
    if (this.parts.childElementCount === taken.length) return;
    this.parts.replaceChildren(
      ...taken.map((middle) =>
        s("path", { class: "part", d: `M${at(middle - half)}A${RADIUS} ${RADIUS} 0 0 1 ${at(middle + half)}` }),
      ),
    );
    const share = Math.min(1, (2 * half * taken.length) / 1.2 / 360);
    this.element.setAttribute("aria-label", `Turned by ${Math.round(100 * share)} %`);
  }
}
