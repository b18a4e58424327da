/** Numbers in plain words. */

import type { Answer } from "./types";

/** How sure an answer is, for people. */
export function confidenceWords(confidence: number | null): string {
  if (confidence === null) return "No confidence is known for this model";
  if (confidence >= 0.95) return "Almost certainly here";
  if (confidence >= 0.8) return "Very likely here";
  if (confidence >= 0.5) return "Probably here";
  if (confidence >= 0.2) return "Perhaps here, perhaps elsewhere";
  return "A guess: this may be somewhere else, or not of this plan";
}

export const percent = (share: number): string =>
  share > 0 && share < 0.01 ? "under 1 %" : share > 0.99 && share < 1 ? "over 99 %" : `${Math.round(100 * share)} %`;

export const milliseconds = (duration: number): string =>
  duration >= 1000 ? `${(duration / 1000).toFixed(1)} s` : `${Math.round(duration)} ms`;

/** How far off the position is, along the long axis of the ellipse. */
export function accuracyWords(answer: Answer): string | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2;
  const deviation = Math.sqrt(0.5 * (xx + yy) + Math.hypot(0.5 * (xx - yy), xy));
  return deviation < 1 ? `± ${Math.max(1, Math.round(100 * deviation))} cm` : `± ${deviation.toFixed(1)} m`;
}

/** Where a heading came from. */
export const HEADING_SOURCES: Record<Answer["heading_source"], string> = {
  given: "as you said",
  panorama: "from the photograph’s compass",
  searched: "found from the picture",
};

/** Answers without LPO or VDR are coarser than they could be. */
export const STAGES: Record<Answer["stage"], string> = {
  lpo: "optimised pose",
  vdr: "dense sampling; the optimiser had no time",
  retrieval: "nearest pose of the grid",
};
