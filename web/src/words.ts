/** Numbers in plain words. */

import type { Answer } from "./types";

/** Describe a confidence. */
export function confidenceWords(confidence: number | null): string {
  if (confidence === null) return "Unknown confidence: the model is not calibrated";
  if (confidence >= 0.95) return "Almost certainly here";
  if (confidence >= 0.8) return "Very likely here";
  if (confidence >= 0.5) return "Probably here";
  if (confidence >= 0.2) return "Possibly here";
  return "Uncertain: possibly another place, or not in this plan";
}

export const percent = (share: number): string =>
  share > 0 && share < 0.01 ? "under 1 %" : share > 0.99 && share < 1 ? "over 99 %" : `${Math.round(100 * share)} %`;

export const milliseconds = (duration: number): string =>
  duration >= 1000 ? `${(duration / 1000).toFixed(1)} s` : `${Math.round(duration)} ms`;

/** Return the standard deviation of the position along the longer axis of the ellipse. */
export function accuracyWords(answer: Answer): string | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2;
  const deviation = Math.sqrt(0.5 * (xx + yy) + Math.hypot(0.5 * (xx - yy), xy));
  return deviation < 1 ? `± ${Math.max(1, Math.round(100 * deviation))} cm` : `± ${deviation.toFixed(1)} m`;
}

/** Origin of a heading. */
export const HEADING_SOURCES: Record<Answer["heading_source"], string> = {
  given: "as given",
  panorama: "from the photograph’s metadata",
  searched: "estimated from the picture",
};

/** Last stage of an answer; without LPO it is coarser. */
export const STAGES: Record<Answer["stage"], string> = {
  lpo: "refined pose (LPO)",
  vdr: "dense sampling (VDR), not refined",
  retrieval: "nearest pose of the pose grid, not refined",
};
