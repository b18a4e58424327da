/** Queries about one photograph, or about several of one visit, and their answers. */

import { api } from "./api";
import { device } from "./device/device";
import { hintFields } from "./hints";
import { InputError } from "./notices";
import type { Photo } from "./photos";
import type { Answer, ChosenVenue, Plan, SequenceAnswer } from "./types";

export type Place = Plan | ChosenVenue;

const isVenue = (place: Place): place is ChosenVenue => "listed" in place;
const placeFields = (place: Place): Record<string, string> =>
  isVenue(place) ? { venue_id: place.id } : { floorplan_id: place.id };

/** Ask for one photograph in a venue, or in a plan with a map of its probabilities. */
export async function askSingle(place: Place, photo: Photo, signal: AbortSignal): Promise<void> {
  const fields = { ...placeFields(place), ...hintFields(photo.hints), ...photo.settings };
  photo.asked = { fields, files: [photo.file], onDevice: device.isOn };
  const answer = await device.send(
    [photo.file],
    isVenue(place) ? fields : { ...fields, include: "posterior" },
    ([picture], own) => api.localise(own, picture!, { signal }),
  );
  if (!signal.aborted) photo.answer = answer;
}

/** Ask for the film of a turn; return the answer to its first frame. */
export async function askFilm(place: Place, film: File, signal: AbortSignal): Promise<Answer> {
  if (device.isOn)
    throw new InputError(
      "Films are sent to the service. Untick “Keep this photograph on my device”, or add photographs.",
    );
  return answerOf(await api.localiseFilm(placeFields(place), film, { signal }), 0, place);
}

/** Ask for the photographs of a turn together. */
export async function askTogether(place: Place, photos: readonly Photo[], signal: AbortSignal): Promise<void> {
  const { heading_deg: _, heading_tolerance_deg: tolerance, ...shared } = photos[0]!.settings;
  const headings = photos.map(({ settings }) =>
    settings.heading_deg === undefined ? null : Number(settings.heading_deg),
  );
  const fields: Record<string, string> = { ...placeFields(place), motion: "turn", ...shared };
  if (headings.some((heading) => heading !== null)) {
    fields.headings_deg = JSON.stringify(headings);
    if (tolerance !== undefined) fields.heading_tolerance_deg = tolerance;
  }
  const files = photos.map(({ file }) => file),
    onDevice = device.isOn;
  const ask = (more: Record<string, string>): Promise<SequenceAnswer> =>
    device.send(files, { ...fields, ...more }, (pictures, own) => api.localiseSequence(own, pictures, { signal }));
  const directions = photos.map(({ direction }) => direction),
    told = !directions.includes(null) ? { relative_heading_deg: JSON.stringify(directions) } : null;
  // Features do not overlap. Photographs tell angles and field of view better than a gyroscope, where they overlap.
  let found = await ask(told !== null && onDevice ? told : {});
  const [first] = found.poses,
    areSeen = found.poses.every(({ view }) => view?.relative_heading?.source === "estimated");
  if (told !== null && !onDevice && first?.view != null && !areSeen)
    found = await ask({ ...told, hfov_deg: String(first.view.hfov.value_deg) });
  if (signal.aborted) return;
  photos.forEach((photo, index) => {
    photo.asked = { fields, files, onDevice };
    photo.answer = answerOf(found, index, place);
  });
}

/** Return the answer to one photograph of several. */
function answerOf(found: SequenceAnswer, index: number, place: Place): Answer {
  const { poses, confidence, warnings, floorplan_revision, ...common } = found;
  const pose = poses[index]!;
  const among = new Set(pose.candidates.map(({ floorplan_id }) => floorplan_id));
  return {
    ...common,
    ...pose,
    // Warnings about photographs are also those of their poses.
    warnings: [
      ...pose.warnings,
      ...warnings.filter((text) => !text.startsWith("photo[")),
      ...(found.film?.warnings ?? []),
    ],
    floorplan_revision: pose.floorplan_id === found.floorplan_id ? floorplan_revision : undefined,
    level: pose.level ?? null,
    // A sequence has no probabilities of plans.
    plans: isVenue(place)
      ? place.listed
          .filter(({ floorplan_id }) => among.has(floorplan_id))
          .map((plan) => ({ ...plan, probability: null }))
      : null,
    answer_id: null,
    posterior: null,
    together: { photographs: poses.length, confidence },
  };
}
