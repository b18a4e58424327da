/** What an answer adds to a plan besides the heat map: the ellipse of the found place, and its rivals. */

import { s } from "./dom";
import { degrees } from "./layout";
import { type Box, unitOf } from "./plan_drawing";
import type { Answer } from "./types";

// Rivals that are less probable are drawn faintly.
const LEAST_RIVAL = 0.001;
// 95 % of a two-dimensional normal distribution lie within so many standard deviations.
const WITHIN_95 = Math.sqrt(5.991);

/** The ellipse that holds 95 % of where the camera may have stood. */
export function ellipse(answer: Answer): SVGElement | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2;
  const middle = 0.5 * (xx + yy), apart = Math.hypot(0.5 * (xx - yy), xy);
  const radii = [middle + apart, Math.max(middle - apart, 0)].map((variance) => WITHIN_95 * Math.sqrt(variance));
  // The axis of the larger one, counterclockwise from +x; clockwise on the drawing, whose y is turned over.
  const turn = -0.5 * degrees(Math.atan2(2 * xy, xx - yy));
  const { x_m, y_m } = answer.position;
  return s("ellipse", { class: "covariance", rx: radii[0]!, ry: radii[1]!, transform: `translate(${x_m} ${-y_m}) rotate(${turn})` });
}

/** Places of a plan that were considered besides the answer, by their rank; `look` is called with the one that was chosen. */
export function rivals(answer: Answer, planId: string, box: Box, look: (index: number) => void): SVGGElement {
  const unit = unitOf(box);
  return s("g", { class: "rivals" }, ...answer.candidates.slice(1).map((candidate, index) => {
    if (candidate.floorplan_id !== planId) return s("g");
    const { x_m, y_m } = candidate.position;
    const faint = candidate.probability !== null && candidate.probability < LEAST_RIVAL ? " faint" : "";
    return s("g", { class: `rival${faint}`, transform: `translate(${x_m} ${-y_m})`, onclick: () => look(index + 1) },
      s("circle", { r: 1.5 * unit }), s("text", { "font-size": 1.9 * unit, y: 0.68 * unit }, index + 2));
  }));
}
