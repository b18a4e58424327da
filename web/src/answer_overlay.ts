/** Answer on the plan, besides the heat map: covariance ellipse and other candidates. */

import { s } from "./dom";
import { degrees, radians } from "./layout";
import type { Photo } from "./photos";
import { placesOf } from "./places";
import { type Box, unitOf } from "./plan_drawing";
import type { Answer } from "./types";

// 95 % of a normal distribution in two dimensions lie within this many standard deviations.
const WITHIN_95 = Math.sqrt(5.991);

/** Covariance of x, y and perhaps more. */
type Covariance = [[number, number, ...number[]], [number, number, ...number[]], ...number[][]];

/** Return the radii (m) of the ellipse that contains a position with a probability of 95 %, the longer one first. */
export function within95([[xx, xy], [, yy]]: Covariance): [number, number] {
  const mean = 0.5 * (xx + yy),
    spread = Math.hypot(0.5 * (xx - yy), xy);
  return [WITHIN_95 * Math.sqrt(mean + spread), WITHIN_95 * Math.sqrt(Math.max(mean - spread, 0))];
}

/** Draw the ellipse that contains the camera with a probability of 95 %. */
export function ellipse(answer: Pick<Answer, "position"> & { covariance_m2: Covariance | null }): SVGElement | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2,
    [major, minor] = within95(answer.covariance_m2);
  // Direction of the longer axis, counterclockwise from +x; negative because y points down in SVG.
  const turn = -0.5 * degrees(Math.atan2(2 * xy, xx - yy));
  const { x_m, y_m } = answer.position;
  return s("ellipse", {
    class: "covariance",
    rx: major,
    ry: minor,
    transform: `translate(${x_m} ${-y_m}) rotate(${turn})`,
  });
}

/** Draw the other places of a plan with their ranks; a click calls `select` with the index of the candidate. */
export function otherPlaces(answer: Answer, planId: string, box: Box, select: (index: number) => void): SVGGElement {
  const unit = unitOf(box);
  return s(
    "g",
    { class: "rivals" },
    ...placesOf(answer).map(({ index, candidate }, rank) => {
      if (rank === 0 || candidate.floorplan_id !== planId) return null;
      const { x_m, y_m } = candidate.position;
      return s(
        "g",
        { class: "rival", transform: `translate(${x_m} ${-y_m})`, onclick: () => select(index) },
        s("circle", { r: 1.5 * unit }),
        s("text", { "font-size": 1.9 * unit, y: 0.68 * unit }, rank + 1),
      );
    }),
  );
}

/** Draw the places of the other photographs in a plan; a click calls `choose`. */
export function companions(
  photos: readonly Photo[],
  current: Photo | null,
  planId: string,
  box: Box,
  choose: (photo: Photo) => void,
): SVGGElement {
  const unit = unitOf(box);
  return s(
    "g",
    { class: "companions" },
    ...photos.map((photo, index) => {
      if (photo === current || photo.answer === null || photo.answer.floorplan_id !== planId) return null;
      const { position, heading_deg: turn } = photo.answer;
      return s(
        "g",
        { class: "companion", transform: `translate(${position.x_m} ${-position.y_m})`, onclick: () => choose(photo) },
        s("title", {}, `Photograph ${index + 1}: ${photo.file.name}`),
        s("path", { class: "gaze", d: `M0 0V${-5 * unit}`, transform: `rotate(${turn})` }),
        s("circle", { r: 0.9 * unit }),
        s(
          "text",
          {
            "font-size": 1.9 * unit,
            transform: `rotate(${turn}) translate(0 ${-6.6 * unit}) rotate(${-turn})`,
            y: 0.68 * unit,
          },
          `photo ${index + 1}`,
        ),
      );
    }),
  );
}

/** Draw the direction of the next step from the answer: a turn as an arc with an arrow, a door as an arrow to it. */
export function stepArrow(answer: Answer, box: Box): SVGGElement | null {
  const step = answer.view?.next_step;
  if (step == null || step.turn_deg === null) return null;
  const { x_m, y_m } = answer.position,
    unit = unitOf(box);
  const turn = radians(step.turn_deg),
    far = step.distance_m ?? 9 * unit;
  const at = (azimuth: number, length: number): string =>
    `${(length * Math.sin(azimuth)).toFixed(3)} ${(-length * Math.cos(azimuth)).toFixed(3)}`;
  const arc = `M${at(0, 5 * unit)}A${5 * unit} ${5 * unit} 0 0 ${turn > 0 ? 1 : 0} ${at(turn, 5 * unit)}`;
  const tip = [-0.15, 0.15].map((side) => `M${at(turn, far)}L${at(turn + side, far - 1.6 * unit)}`).join("");
  return s(
    "g",
    { class: "next-step", transform: `translate(${x_m} ${-y_m}) rotate(${answer.heading_deg})` },
    s("title", {}, `Next step: ${step.text}`),
    step.kind === "turn" && s("path", { d: arc }),
    s("path", { d: `M${at(turn, step.kind === "turn" ? 5 * unit : 1.5 * unit)}L${at(turn, far)}${tip}` }),
  );
}
