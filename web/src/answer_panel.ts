/** The answer in words: where, how sure, what else it may be, how long it took, and how to ask it elsewhere. */

import { button, byId, h, show } from "./dom";
import { say } from "./notices";
import type { Photo } from "./photos";
import { curlSnippet, pythonSnippet } from "./snippets";
import type { Answer, Candidate } from "./types";
import { planLabel } from "./venues";
import { accuracyWords, confidenceWords, HEADING_SOURCES, milliseconds, percent, STAGES } from "./words";

const MOST_PLANS = 3;

export interface AnswerActions {
  /** Move the marker to a candidate. */
  look: (index: number) => void;
  /** Draw the answer to a photograph as a picture to keep. */
  save: (photo: Photo) => Promise<void>;
}

/** Show an answer; null takes the previous one away. */
export function showAnswer(answer: Answer | null, photo: Photo | null, actions: AnswerActions): void {
  const panel = byId("answer");
  panel.hidden = answer === null;
  if (answer === null) {
    show(byId("answer-body"));
    return;
  }
  show(byId("answer-body"), verdict(answer), ...warnings(answer), places(answer, actions), facts(answer), sharing(answer, photo, actions));
}

/** Mark the candidate that is looked at. */
export function markLooked(index: number | null): void {
  byId("answer-body").querySelectorAll("[data-rank]").forEach((row) => {
    row.setAttribute("aria-pressed", String(index !== null && row.getAttribute("data-rank") === String(index)));
  });
}

function verdict(answer: Answer): HTMLElement {
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
      h("span", {}, `${percent(share)} sure that it is right within 1 m`)));
}

/** What a plan of a venue is called, and its level; of the less probable ones the level alone is known. */
function planOf(answer: Answer, place: { floorplan_id: string; level: number | null }): string {
  const plan = answer.plans?.find((one) => one.floorplan_id === place.floorplan_id);
  return plan === undefined ? `level ${place.level}` : planLabel(plan);
}

function warnings(answer: Answer): HTMLElement[] {
  return answer.warnings.map((warning) => h("p", { class: "warning" }, warning));
}

function places(answer: Answer, { look }: AnswerActions): HTMLElement {
  const row = (candidate: Candidate, index: number): HTMLElement => {
    const share = candidate.probability;
    return h("li", {}, h("button", { type: "button", "data-rank": index, "aria-pressed": String(index === 0), onclick: () => look(index) },
      h("span", { class: "rank" }, index + 1),
      h("span", { class: "name" }, candidate.room, answer.venue_id != null && h("small", {}, planOf(answer, candidate))),
      h("meter", { min: 0, max: 1, value: share ?? 0, "aria-hidden": "true" }),
      h("span", { class: "share" }, share === null ? "" : percent(share))));
  };
  return h("div", { class: "places" }, h("h3", {}, "Places, the likeliest first"), h("ol", {}, ...answer.candidates.map(row)));
}

function facts(answer: Answer): HTMLElement {
  const spread = answer.heading_std_deg === null ? "" : ` ± ${answer.heading_std_deg.toFixed(1)}°`;
  const stages = Object.entries(answer.timings_ms).filter(([name, spent]) => name !== "total" && spent > 0)
    .map(([name, spent]) => `${name} ${milliseconds(spent)}`);
  const likely = (answer.plans ?? []).filter(({ probability }) => probability !== null).slice(0, MOST_PLANS)
    .map((plan) => `${planLabel(plan)}: ${percent(plan.probability!)}`);
  const earth = answer.geopose?.position;
  const pairs: [string, string][] = [
    ...(likely.length > 0 ? [["Plans", likely.join("; ")] as [string, string]] : []),
    ...(earth ? [["On Earth", `${earth.lat.toFixed(6)}, ${earth.lon.toFixed(6)}`] as [string, string]] : []),
    ["Heading", `${answer.heading_deg.toFixed(1)}°${spread}, ${HEADING_SOURCES[answer.heading_source]}`],
    ["Camera height", `${answer.camera_height_m.toFixed(2)} m fits best`],
    ["Time", `${milliseconds(answer.timings_ms.total ?? 0)} (${stages.join(", ")})`],
    ["How", `${STAGES[answer.stage]}, model ${answer.model.name} ${answer.model.version}`],
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
    // The service draws answers about single plans, and does not keep photographs.
    photo !== null && answer.venue_id == null && button("Save picture", () => void save(photo), { id: "save-picture", title: "The photograph with the layout, and the plan with the place, as PNG" }),
    link !== null && button("Copy link", () => void copy(link, "link"), { id: "copy-link", title: "Opens this answer again while the service keeps it" }),
    h("pre", { class: "copied", id: "copied", tabindex: 0, hidden: true, "aria-label": "What was copied" }));
}

async function copy(text: string, what: string): Promise<void> {
  const shown = byId("copied");
  shown.textContent = text;
  shown.hidden = false;
  try {
    await navigator.clipboard.writeText(text);
    say(`Copied the ${what}.`);
  } catch {
    // Pages that did not come over https may not write to the clipboard.
    getSelection()?.selectAllChildren(shown);
    say(`Select and copy the ${what} below.`);
  }
}
