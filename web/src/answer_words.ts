/** Words for the parts of an answer. */

import { within95 } from "./answer_overlay";
import { percent } from "./plain_words";
import type { Answer, ViewAnswer } from "./types";

// 95 % of a normal distribution lie within this many standard deviations.
const NORMAL_95 = 1.96;

/** Describe a confidence. */
export function confidenceWords(confidence: number | null): string {
  if (confidence === null) return "Unknown confidence: the model is not calibrated";
  if (confidence >= 0.95) return "Almost certainly here";
  if (confidence >= 0.8) return "Very likely here";
  if (confidence >= 0.5) return "Probably here";
  if (confidence >= 0.2) return "Possibly here";
  return "Uncertain: possibly another place, or not in this plan";
}

export const milliseconds = (duration: number): string =>
  duration >= 1000 ? `${(duration / 1000).toFixed(1)} s` : `${Math.round(duration)} ms`;

/** Return a position with its 95 % radius along the longer axis of the ellipse on the plan. */
export function placeWords({ position: { x_m, y_m }, covariance_m2: covariance }: Answer): string {
  const place = `x ${x_m.toFixed(2)} m, y ${y_m.toFixed(2)} m`;
  if (covariance === null) return place;
  const [radius] = within95(covariance);
  return `${place} ± ${radius < 1 ? `${Math.max(1, Math.round(100 * radius))} cm` : `${radius.toFixed(1)} m`}`;
}

/** Return an answer in two lines, for a picture of it. */
export function captionWords(answer: Answer): string[] {
  return [
    `${answer.room}: ${placeWords(answer)}, heading ${headingWords(answer.heading_deg, answer.heading_std_deg)}`,
    answer.confidence === null
      ? confidenceWords(null)
      : `${confidenceWords(answer.confidence)}; ${percent(answer.confidence)} probability of an error below 1 m`,
  ];
}

/** Return a heading with its 95 % interval. */
export const headingWords = (headingDeg: number, deviationDeg: number | null): string =>
  angleWords(Math.round(headingDeg) % 360, deviationDeg ?? 0);

/** Describe what was assumed about a photograph, with the origin of each value. */
export function viewWords(view: ViewAnswer): string {
  const { projection, hfov, pitch, roll, camera } = view;
  const kind = `Read as ${PROJECTIONS[projection]}`;
  if (camera === null && projection === "equirectangular" && hfov.value_deg >= 360) return `${kind}.`;
  const width = `, ${angleWords(hfov.value_deg, hfov.std_deg)} wide (${VALUE_SOURCES[hfov.source]})`;
  if (camera === null) return `${kind}${width}.`;
  const tilt = `tilted ${directed(pitch, "up", "down")} and leaning ${directed(roll, "right", "left")}`;
  const sources =
    pitch.source === roll.source
      ? VALUE_SOURCES[pitch.source]
      : `${VALUE_SOURCES[pitch.source]}; ${VALUE_SOURCES[roll.source]}`;
  return `${kind}${width}, ${tilt} (${sources}).`;
}

/** Describe how much of the surroundings an answer's photographs show, and what that rules out. */
export function seenWords(view: ViewAnswer): string {
  return `${seenDeg(view).toFixed(0)}° of 360° of the surroundings are seen; that rules out ${percent(view.ruled_out)} of the area.`;
}

/** Describe the room by recognised objects, as in "Looks like a kitchen: stove, refrigerator"; null if nothing tells. */
export function roomWords({ room_types: types, objects }: ViewAnswer): string | null {
  const [likeliest] = Object.entries(types ?? {});
  if (likeliest === undefined || likeliest[1] < TELLING) return null;
  const [type, share] = likeliest;
  const names = (objects ?? []).slice(0, 3).map(({ name }) => name);
  const shown = names.length === 0 ? "" : `: ${names.join(", ")}`;
  return `Looks like ${ROOM_WORDS[type] ?? `a ${type}`} (${percent(share)})${shown}.`;
}

/** Return advice how to photograph the place for a sure answer; null if there is none. */
export function adviceWords(answer: Answer): string | null {
  const { view, together } = answer;
  if (view === null || view === undefined || view.advice === null) return null;
  const seen = `${seenDeg(view).toFixed(0)}° of the surroundings are too little to tell the place`;
  return together !== undefined
    ? `Turn further: ${seen}. Add more photographs from the same spot.`
    : `Turn around: ${seen}. Add photographs from the same spot, each turned by at most half the field of view, and choose “Taken from one spot, turning”.`;
}

/** Return the step that makes an unsure answer surest; null if there is none. */
export const stepWords = ({ view }: Answer): string | null =>
  view?.next_step ? `Next: ${view.next_step.text}.` : null;

function seenDeg({ seen }: ViewAnswer): number {
  return seen.reduce((sum, { from_deg, to_deg }) => sum + to_deg - from_deg, 0);
}

function angleWords(value: number, deviation: number): string {
  const spread = NORMAL_95 * deviation;
  return `${value.toFixed(0)}°${spread < 0.5 ? "" : ` ± ${spread.toFixed(0)}°`}`;
}

function directed({ value_deg, std_deg }: ViewAnswer["pitch"], positive: string, negative: string): string {
  return `${value_deg < -0.5 ? negative : positive} by ${angleWords(Math.abs(value_deg), std_deg)}`;
}

// A photograph that shows no telling object has about the same probability for all types.
const TELLING = 0.25;

const ROOM_WORDS: Record<string, string> = {
  living: "a living room",
  dining: "a dining room",
  entrance: "an entrance",
  storage: "a storage room",
  laundry: "a laundry room",
  stairs: "stairs",
  office: "an office",
  meeting: "a meeting room",
};

const PROJECTIONS: Record<ViewAnswer["projection"], string> = {
  equirectangular: "a 360° photograph",
  perspective: "an ordinary photograph",
  cylindrical: "a strip of a phone’s panorama mode",
  fisheye: "a fisheye photograph",
};

/** Origin of a value of the camera. */
const VALUE_SOURCES: Record<ViewAnswer["pitch"]["source"], string> = {
  given: "as entered",
  gpano: "from the file",
  exif: "from the file",
  estimated: "estimated from lines in the picture",
  assumed: "a usual value",
};

/** Origin of a heading. */
export const HEADING_SOURCES: Record<Answer["heading_source"], string> = {
  given: "as given",
  photograph: "from the photograph’s metadata",
  searched: "estimated from the picture",
};

/** Last stage of an answer; without LPO it is coarser. */
export const STAGES: Record<Answer["stage"], string> = {
  lpo: "refined pose (LPO)",
  vdr: "dense sampling (VDR), not refined",
  retrieval: "nearest pose of the pose grid, not refined",
};
