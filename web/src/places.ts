/** Candidates of an answer as places: candidates within 1 m of each other are one place, whose probabilities add up. */

import type { Answer, Candidate } from "./types";

// An answer is right within this distance.
const RIGHT_WITHIN_M = 1;
// Places and headings below this probability are not shown; it rounds to 0 %.
const MIN_SHARE = 0.005;

export interface Place {
  /** Index of the most probable candidate in the answer. */
  index: number;
  candidate: Candidate;
  probability: number | null;
  /** Indices of the place's other candidates, which look in other directions. */
  others: number[];
}

/** Return the places of an answer in the order of its candidates; the first is the answer's. */
export function placesOf(answer: Answer): Place[] {
  const places: Place[] = [];
  answer.candidates.forEach((candidate, index) => {
    const share = candidate.probability;
    const place = places.find((known) => isSamePlace(known.candidate, candidate));
    if (place !== undefined) {
      if (share !== null && place.probability !== null) place.probability += share;
      if (isShown(share)) place.others.push(index);
    } else places.push({ index, candidate, probability: share, others: [] });
  });
  const [first] = places;
  // The candidates can leave out headings between theirs; the confidence counts all.
  if (first !== undefined && first.probability !== null)
    first.probability = Math.max(first.probability, answer.confidence ?? 0);
  return places.filter(({ probability }, rank) => rank === 0 || isShown(probability));
}

/** Return the probability of the places of the plan that are near no candidate; null if unknown. */
export function remainder(answer: Answer, places: Place[]): number | null {
  const elsewhere = answer.probability_elsewhere;
  if (elsewhere === null || elsewhere === undefined) return null;
  const rest = places.reduce((left, { probability }) => left - (probability ?? 0), 1 - elsewhere);
  return rest < MIN_SHARE ? null : rest;
}

const isShown = (share: number | null): boolean => share === null || share >= MIN_SHARE;

function isSamePlace(a: Candidate, b: Candidate): boolean {
  const distance = Math.hypot(a.position.x_m - b.position.x_m, a.position.y_m - b.position.y_m);
  return a.floorplan_id === b.floorplan_id && distance < RIGHT_WITHIN_M;
}
