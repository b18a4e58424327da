/** Answer on the plan, besides the heat map: covariance ellipse and other candidates. */

import { s } from "./dom";
import { degrees } from "./layout";
import { type Box, unitOf } from "./plan_drawing";
import type { Answer } from "./types";

// Candidates below this probability are drawn faintly.
const FAINT_PROBABILITY = 0.001;
// 95 % of a two-dimensional normal distribution lie within this many standard deviations.
const WITHIN_95 = Math.sqrt(5.991);

/** Draw the ellipse that contains the camera with a probability of 95 %. */
export function ellipse(answer: Answer): SVGElement | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2;
  const mean = 0.5 * (xx + yy), spread = Math.hypot(0.5 * (xx - yy), xy);
  const radii = [mean + spread, Math.max(mean - spread, 0)].map((variance) => WITHIN_95 * Math.sqrt(variance));
  // Direction of the longer axis, counterclockwise from +x; negative because y points down in SVG.
  const turn = -0.5 * degrees(Math.atan2(2 * xy, xx - yy));
  const { x_m, y_m } = answer.position;
  return s("ellipse", { class: "covariance", rx: radii[0]!, ry: radii[1]!, transform: `translate(${x_m} ${-y_m}) rotate(${turn})` });
}

/** Draw the other candidates of a plan with their ranks; a click calls `select` with the index. */
export function otherCandidates(answer: Answer, planId: string, box: Box, select: (index: number) => void): SVGGElement {
  const unit = unitOf(box);
  return s("g", { class: "rivals" }, ...answer.candidates.slice(1).map((candidate, index) => {
    if (candidate.floorplan_id !== planId) return s("g");
    const { x_m, y_m } = candidate.position;
    const faint = candidate.probability !== null && candidate.probability < FAINT_PROBABILITY ? " faint" : "";
    return s("g", { class: `rival${faint}`, transform: `translate(${x_m} ${-y_m})`, onclick: () => select(index + 1) },
      s("circle", { r: 1.5 * unit }), s("text", { "font-size": 1.9 * unit, y: 0.68 * unit }, index + 2));
  }));
}
