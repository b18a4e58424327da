/** Links to answers: by the id of one that the service keeps, else with the answer in the link, which nobody computes again. */

import { InputError } from "./notices";
import type { Answer } from "./types";

// Longest answer in a link, packed (characters) and as JSON (bytes): browsers cut longer addresses.
const MAX_PACKED = 60_000,
  MAX_BYTES = 400_000;
const FROM_LINK = "This answer was read from the link; the service did not compute it again.";

/** Return the link to an answer. It has neither the photograph nor an API key. */
export async function linkTo(answer: Answer): Promise<string> {
  const page = `${location.origin}${location.pathname}`;
  if (answer.answer_id != null) return `${page}#answer=${answer.answer_id}`;
  // The map of probabilities is longer than addresses may be.
  const text = JSON.stringify({ ...answer, posterior: null });
  const packed = new Blob([text]).stream().pipeThrough(new CompressionStream("deflate-raw"));
  const link = toText(new Uint8Array(await new Response(packed).arrayBuffer()));
  if (link.length > MAX_PACKED || text.length > MAX_BYTES)
    throw new InputError(`The answer has ${link.length} characters; the limit of a link is ${MAX_PACKED}.`);
  return `${page}#answer-data=${link}`;
}

/** Return the answer in a link. Rejects if it is damaged. */
export async function linkedAnswer(packed: string): Promise<Answer> {
  try {
    if (packed.length > MAX_PACKED) throw new RangeError("too long");
    const answer: unknown = JSON.parse(await unpacked(fromText(packed)));
    if (!isAnswer(answer)) throw new TypeError("no answer");
    return { ...answer, answer_id: null, posterior: null, warnings: [...(answer.warnings ?? []), FROM_LINK] };
  } catch {
    throw new InputError("The link to the answer is damaged or incomplete. Copy it again as a whole.");
  }
}

async function unpacked(bytes: Uint8Array<ArrayBuffer>): Promise<string> {
  const reader = new Blob([bytes])
    .stream()
    .pipeThrough(new DecompressionStream("deflate-raw"))
    .pipeThrough(new TextDecoderStream())
    .getReader();
  let text = "";
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    text += part.value;
    if (text.length > MAX_BYTES) {
      await reader.cancel();
      throw new RangeError("too long");
    }
  }
  return text;
}

/** Return whether a value has the fields of an answer that the page draws. */
function isAnswer(value: unknown): value is Answer {
  if (typeof value !== "object" || value === null) return false;
  const { floorplan_id, position, candidates, timings_ms, model } = value as Partial<Answer>;
  const isPlace = (place: unknown): boolean => {
    const { x_m, y_m } = (place ?? {}) as Partial<Answer["position"]>;
    return Number.isFinite(x_m) && Number.isFinite(y_m);
  };
  return (
    typeof floorplan_id === "string" &&
    isPlace(position) &&
    Array.isArray(candidates) &&
    candidates.length > 0 &&
    candidates.every((candidate) => isPlace(candidate?.position) && Number.isFinite(candidate.heading_deg)) &&
    typeof timings_ms === "object" &&
    typeof model === "object"
  );
}

function toText(bytes: Uint8Array): string {
  let text = "";
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

function fromText(text: string): Uint8Array<ArrayBuffer> {
  const bytes = atob(text.replaceAll("-", "+").replaceAll("_", "/"));
  return Uint8Array.from(bytes, (character) => character.charCodeAt(0));
}
