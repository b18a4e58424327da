/** Queries about one photograph, or about several of one visit, and their answers. */

import { api } from "./api";
import { device } from "./device/device";
import { hintFields } from "./hints";
import type { Group, Photo } from "./photos";
import type { Answer, Plan, SequenceAnswer, Venue } from "./types";

/** Ask for one photograph in a venue, or in a plan with a map of its probabilities. */
export async function askSingle(place: Venue | Plan, photo: Photo, signal: AbortSignal): Promise<void> {
  const isVenue = "plans" in place;
  const fields: Record<string, string> = isVenue
    ? { venue_id: place.id, ...photo.settings }
    : { floorplan_id: place.id, ...hintFields(photo.hints), ...photo.settings };
  photo.asked = { fields, files: [photo.file], onDevice: device.isOn };
  const answer = await device.send(
    [photo.file],
    isVenue ? fields : { ...fields, include: "posterior" },
    ([picture], own) => api.localise(own, picture!, { signal }),
  );
  if (!signal.aborted) photo.answer = answer;
}

/** Ask for photographs of one visit together. */
export async function askTogether(plan: Plan, { motion, photos }: Group, signal: AbortSignal): Promise<void> {
  const { heading_deg: _, heading_tolerance_deg: tolerance, ...shared } = photos[0]!.settings;
  const headings = photos.map(({ settings }) =>
    settings.heading_deg === undefined ? null : Number(settings.heading_deg),
  );
  const fields: Record<string, string> = { floorplan_id: plan.id, motion, ...shared };
  if (headings.some((heading) => heading !== null)) {
    fields.headings_deg = JSON.stringify(headings);
    if (tolerance !== undefined) fields.heading_tolerance_deg = tolerance;
  }
  const files = photos.map(({ file }) => file),
    onDevice = device.isOn;
  const found = await device.send(files, fields, (pictures, own) => api.localiseSequence(own, pictures, { signal }));
  if (signal.aborted) return;
  photos.forEach((photo, index) => {
    photo.asked = { fields, files, onDevice };
    photo.answer = answerOf(found, index, motion);
  });
}

/** Return the answer to one photograph of several. */
function answerOf(found: SequenceAnswer, index: number, motion: Group["motion"]): Answer {
  const { poses, confidence, warnings, ...common } = found,
    pose = poses[index]!;
  return {
    ...common,
    ...pose,
    warnings: [...pose.warnings, ...warnings],
    venue_id: null,
    level: null,
    plans: null,
    answer_id: null,
    posterior: null,
    together: { motion, photographs: poses.length, confidence },
  };
}
