/** What an answer adds to a plan: the posterior as a heat map, the found place with its ellipse, and its rivals. */

import { s } from "./dom";
import { degrees } from "./layout";
import { type Box, path, unitOf } from "./plan_drawing";
import type { Answer, PlanDocument, Posterior } from "./types";

const LEAST = 1e-5;
// 95 % of a two-dimensional normal distribution lie within so many standard deviations.
const WITHIN_95 = Math.sqrt(5.991);

/** From 0 for what is next to impossible to 1 for what is certain, on the scale of the logarithm. */
export function heat(probability: number): number {
  return Math.max(0, Math.min(1, 1 - Math.log(Math.max(probability, LEAST)) / Math.log(LEAST)));
}

/** Cells around the poses of the grid, cut off at the walls: one colour, denser where it is likelier. */
export function heatMap(posterior: Posterior, plan: PlanDocument): SVGGElement {
  const step = posterior.step_m;
  const clip = s("clipPath", { id: "floor" }, ...plan.rooms.map((room) =>
    s("path", { d: path(room.polygon) + (room.holes ?? []).map(path).join(""), "clip-rule": "evenodd" })));
  const cells = posterior.x_m.map((x, index) => {
    const value = heat(posterior.probability[index]!);
    const y = posterior.y_m[index]!;
    return s("rect", {
      x: (x - 0.5 * step).toFixed(3), y: (-y - 0.5 * step).toFixed(3), width: step, height: step,
      "fill-opacity": (0.08 + 0.84 * value).toFixed(2),
    });
  });
  const blur = s("filter", { id: "soft", x: "-20%", y: "-20%", width: "140%", height: "140%" },
    s("feGaussianBlur", { stdDeviation: 0.35 * step }));
  return s("g", { class: "heat", "aria-hidden": "true" }, s("defs", {}, clip, blur),
    s("g", { "clip-path": "url(#floor)" }, s("g", { filter: "url(#soft)" }, ...cells)));
}

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
    return s("g", { class: "rival", transform: `translate(${x_m} ${-y_m})`, onclick: () => look(index + 1) },
      s("circle", { r: 1.5 * unit }), s("text", { "font-size": 1.9 * unit, y: 0.68 * unit }, index + 2));
  }));
}
