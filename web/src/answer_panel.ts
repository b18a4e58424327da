/** Answer as text: place, confidence, other candidates, timings, and code for the same query. */

import { button, byId, h, show } from "./dom";
import { say } from "./notices";
import type { Photo } from "./photos";
import { curlSnippet, pythonSnippet } from "./snippets";
import type { Answer, Candidate } from "./types";
import { planLabel } from "./venues";

const MAX_PLANS = 3;

export interface AnswerActions {
  /** Move the marker to a candidate. */
  select: (index: number) => void;
  /** Save the answer to a photograph as a picture. */
  save: (photo: Photo) => Promise<void>;
}

/** Show an answer; null removes the previous one. */
export function showAnswer(answer: Answer | null, photo: Photo | null, actions: AnswerActions): void {
  const panel = byId("answer");
  panel.hidden = answer === null;
  if (answer === null) {
    show(byId("answer-body"));
    return;
  }
  show(byId("answer-body"), summary(answer), ...warnings(answer), candidates(answer, actions), facts(answer), sharing(answer, photo, actions));
}

/** Mark the selected candidate. */
export function markSelected(index: number | null): void {
  byId("answer-body").querySelectorAll("[data-rank]").forEach((row) => {
    row.setAttribute("aria-pressed", String(index !== null && row.getAttribute("data-rank") === String(index)));
  });
}

function summary(answer: Answer): HTMLElement {
  const share = answer.confidence ?? 0;
  const { x_m, y_m } = answer.position;
  const accuracy = accuracyWords(answer);
  return h("div", { class: "verdict" },
    h("p", { class: "words" }, confidenceWords(answer.confidence)),
    h("p", { class: "room" }, answer.room),
    answer.venue_id != null && h("p", { class: "plan-of" }, planOf(answer, answer)),
    h("p", { class: "where" }, `x ${x_m.toFixed(2)} m, y ${y_m.toFixed(2)} m`, accuracy && h("span", { title: "One standard deviation, along the longer axis" }, ` ${accuracy}`)),
    answer.confidence !== null && h("div", { class: "sure" },
      h("meter", { min: 0, max: 1, value: share, "aria-label": "Confidence" }),
      h("span", {}, `${percent(share)} probability of an error below 1 m`)));
}

/** Return name and level of a plan of a venue; the answer names only the most probable plans. */
function planOf(answer: Answer, place: { floorplan_id: string; level: number | null }): string {
  const plan = answer.plans?.find(({ floorplan_id }) => floorplan_id === place.floorplan_id);
  return plan === undefined ? `level ${place.level}` : planLabel(plan);
}

function warnings(answer: Answer): HTMLElement[] {
  return answer.warnings.map((warning) => h("p", { class: "warning" }, warning));
}

function candidates(answer: Answer, { select }: AnswerActions): HTMLElement {
  const row = (candidate: Candidate, index: number): HTMLElement => {
    const share = candidate.probability;
    return h("li", {}, h("button", { type: "button", "data-rank": index, "aria-pressed": String(index === 0), onclick: () => select(index) },
      h("span", { class: "rank" }, index + 1),
      h("span", { class: "name" }, candidate.room, answer.venue_id != null && h("small", {}, planOf(answer, candidate))),
      h("meter", { min: 0, max: 1, value: share ?? 0, "aria-hidden": "true" }),
      h("span", { class: "share" }, share === null ? "" : percent(share))));
  };
  return h("div", { class: "places" }, h("h3", {}, "Candidates, most probable first"), h("ol", {}, ...answer.candidates.map(row)));
}

function facts(answer: Answer): HTMLElement {
  const spread = answer.heading_std_deg === null ? "" : ` ± ${answer.heading_std_deg.toFixed(1)}°`;
  const stages = Object.entries(answer.timings_ms).filter(([name, spent]) => name !== "total" && spent > 0)
    .map(([name, spent]) => `${name} ${milliseconds(spent)}`);
  const plans = (answer.plans ?? []).filter(({ probability }) => probability !== null).slice(0, MAX_PLANS)
    .map((plan) => `${planLabel(plan)}: ${percent(plan.probability!)}`);
  const earth = answer.geopose?.position;
  const pairs: [string, string][] = [
    ...(plans.length > 0 ? [["Plans", plans.join("; ")] as [string, string]] : []),
    ...(earth ? [["On Earth", `${earth.lat.toFixed(6)}, ${earth.lon.toFixed(6)}`] as [string, string]] : []),
    ["Heading", `${answer.heading_deg.toFixed(1)}°${spread}, ${HEADING_SOURCES[answer.heading_source]}`],
    ["Camera height", `${answer.camera_height_m.toFixed(2)} m (best fit)`],
    ["Time", `${milliseconds(answer.timings_ms.total ?? 0)} (${stages.join(", ")})`],
    ["Method", `${STAGES[answer.stage]}, model ${answer.model.name} ${answer.model.version}`],
  ];
  return h("dl", { class: "facts" }, ...pairs.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
}

function sharing(answer: Answer, photo: Photo | null, { save }: AnswerActions): HTMLElement {
  const file = photo?.file.name.replace(/^example-/, "examples/") ?? "photo.jpg";
  const fields = photo?.fields ?? (answer.venue_id != null ? { venue_id: answer.venue_id } : { floorplan_id: answer.floorplan_id });
  const link = answer.answer_id == null ? null : `${location.origin}${location.pathname}#answer=${answer.answer_id}`;
  return h("div", { class: "sharing" },
    button("Copy as curl", () => void copy(curlSnippet(fields, file), "curl command"), { id: "copy-curl" }),
    button("Copy as Python", () => void copy(pythonSnippet(fields, file), "Python code"), { id: "copy-python" }),
    // The service draws answers for single plans and does not store photographs.
    photo !== null && answer.venue_id == null && button("Save picture", () => void save(photo), { id: "save-picture", title: "The photograph with the layout, and the plan with the place, as PNG" }),
    link !== null && button("Copy link", () => void copy(link, "link"), { id: "copy-link", title: "Opens this answer again while the service stores it" }),
    h("pre", { class: "copied", id: "copied", tabindex: 0, hidden: true, "aria-label": "Copied text" }));
}

async function copy(text: string, name: string): Promise<void> {
  const shown = byId("copied");
  shown.textContent = text;
  shown.hidden = false;
  try {
    await navigator.clipboard.writeText(text);
    say(`Copied the ${name}.`);
  } catch {
    // Browsers allow writing to the clipboard on https pages only.
    getSelection()?.selectAllChildren(shown);
    say(`Select and copy the ${name} below.`);
  }
}

/** Describe a confidence. */
function confidenceWords(confidence: number | null): string {
  if (confidence === null) return "Unknown confidence: the model is not calibrated";
  if (confidence >= 0.95) return "Almost certainly here";
  if (confidence >= 0.8) return "Very likely here";
  if (confidence >= 0.5) return "Probably here";
  if (confidence >= 0.2) return "Possibly here";
  return "Uncertain: possibly another place, or not in this plan";
}

const percent = (share: number): string =>
  share > 0 && share < 0.01 ? "under 1 %" : share > 0.99 && share < 1 ? "over 99 %" : `${Math.round(100 * share)} %`;

const milliseconds = (duration: number): string =>
  duration >= 1000 ? `${(duration / 1000).toFixed(1)} s` : `${Math.round(duration)} ms`;

/** Return the standard deviation of the position along the longer axis of the ellipse. */
function accuracyWords(answer: Answer): string | null {
  if (answer.covariance_m2 === null) return null;
  const [[xx, xy], [, yy]] = answer.covariance_m2;
  const deviation = Math.sqrt(0.5 * (xx + yy) + Math.hypot(0.5 * (xx - yy), xy));
  return deviation < 1 ? `± ${Math.max(1, Math.round(100 * deviation))} cm` : `± ${deviation.toFixed(1)} m`;
}

/** Origin of a heading. */
const HEADING_SOURCES: Record<Answer["heading_source"], string> = {
  given: "as given",
  panorama: "from the photograph’s metadata",
  searched: "estimated from the picture",
};

/** Last stage of an answer; without LPO it is coarser. */
const STAGES: Record<Answer["stage"], string> = {
  lpo: "refined pose (LPO)",
  vdr: "dense sampling (VDR), not refined",
  retrieval: "nearest pose of the pose grid, not refined",
};
