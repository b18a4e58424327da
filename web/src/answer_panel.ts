/** Answer as text: place, confidence, other candidates, timings, and code for the same query. */

import { linkTo } from "./answer_link";
import {
  adviceWords,
  confidenceWords,
  HEADING_SOURCES,
  headingWords,
  milliseconds,
  placeWords,
  roomWords,
  seenWords,
  stepWords,
  STAGES,
  viewWords,
} from "./answer_words";
import { button, byId, h, show } from "./dom";
import { attempt, say } from "./notices";
import type { Photo } from "./photos";
import { type Place, placesOf, remainder } from "./places";
import { percent, plainWords } from "./plain_words";
import { curlSnippet, pythonSnippet } from "./snippets";
import type { Answer } from "./types";
import { planLabel } from "./venues";

const MAX_PLANS = 3;
// From this probability on, the answer says in words that the photograph can show another place.
const NOTABLE_ELSEWHERE = 0.1;

export interface AnswerActions {
  /** Move the marker to a candidate. */
  select: (index: number) => void;
  /** Save the answer to a photograph as a picture. */
  save: (answer: Answer, photo: Photo | null) => Promise<void>;
}

/** Show an answer; null removes the previous one. */
export function showAnswer(answer: Answer | null, photo: Photo | null, actions: AnswerActions): void {
  const panel = byId("answer");
  panel.hidden = answer === null;
  // The answer is first on narrow screens.
  document.body.classList.toggle("answered", answer !== null);
  if (answer === null) return show(byId("answer-body"));
  show(
    byId("answer-body"),
    summary(answer),
    places(answer, actions),
    ...remarks(answer),
    h("div", { class: "after" }, facts(answer), sharing(answer, photo, actions)),
  );
}

export function markSelected(index: number | null): void {
  byId("answer-body")
    .querySelectorAll("[data-rank]")
    .forEach((row) => {
      row.setAttribute("aria-pressed", String(index !== null && row.getAttribute("data-rank") === String(index)));
    });
}

function summary(answer: Answer): HTMLElement {
  const share = answer.confidence ?? 0,
    heading = headingWords(answer.heading_deg, answer.heading_std_deg);
  return h(
    "div",
    { class: "verdict" },
    h("p", { class: "words" }, confidenceWords(answer.confidence)),
    h("p", { class: "room" }, answer.room),
    answer.venue_id != null && h("p", { class: "plan-of" }, planOf(answer, answer)),
    h("p", { class: "where" }, placeWords(answer)),
    h("p", { class: "hint" }, `Heading ${heading}. ± is a 95 % interval.`),
    answer.confidence !== null &&
      h(
        "div",
        { class: "sure" },
        h("meter", { min: 0, max: 1, value: share, "aria-label": "Confidence" }),
        h("span", {}, `${percent(share)} probability of an error below 1 m`),
      ),
  );
}

/** Return name and level of a plan of a venue; the answer names only the most probable plans. */
function planOf(answer: Answer, place: { floorplan_id: string; level: number | null }): string {
  const plan = answer.plans?.find(({ floorplan_id }) => floorplan_id === place.floorplan_id);
  return plan === undefined ? `level ${place.level}` : planLabel(plan);
}

/** State what was assumed, and what the user can do about an uncertain answer. */
function remarks(answer: Answer): (HTMLElement | false)[] {
  const { view, together } = answer,
    advice = adviceWords(answer),
    step = stepWords(answer),
    looks = view == null ? null : roomWords(view),
    elsewhere = answer.probability_elsewhere ?? 0;
  const warnings = [...new Set([...answer.warnings, ...(view?.warnings ?? [])])].map((warning) =>
    h("p", { class: "warning" }, plainWords(warning)),
  );
  return [
    step !== null && h("p", { class: "advice", id: "next-step" }, step),
    advice !== null && h("p", { class: "advice" }, advice),
    together !== undefined &&
      h(
        "p",
        { class: "assumed" },
        `From ${together.photographs} photographs together`,
        together.confidence === null
          ? "."
          : `: ${percent(together.confidence)} probability that all of their places are right within 1 m.`,
      ),
    elsewhere >= NOTABLE_ELSEWHERE &&
      h(
        "p",
        { class: "assumed" },
        `${percent(elsewhere)} probability that the photograph shows `,
        "no place of this plan: another floor or building, or rooms that have changed.",
      ),
    looks !== null && h("p", { class: "assumed" }, looks),
    view != null && h("p", { class: "assumed" }, viewWords(view)),
    ...warnings,
  ];
}

/** List the places, and the probability of all others. */
function places(answer: Answer, { select }: AnswerActions): HTMLElement {
  const listed = placesOf(answer),
    left = remainder(answer, listed),
    elsewhere = answer.probability_elsewhere ?? 0,
    nowhere = answer.venue_id == null ? "not in this plan" : "in none of the plans";
  const row = ({ index, candidate, probability, others }: Place, rank: number): HTMLElement => {
    const plan = answer.venue_id != null && h("small", {}, planOf(answer, candidate));
    const name = h("span", { class: "name" }, candidate.room, plan);
    const choose = button(cells(rank + 1, name, probability), () => select(index), {
      "data-rank": index,
      "aria-pressed": String(rank === 0),
    });
    const ways = others.map((other) => otherWay(answer, other, select));
    return h("li", {}, choose, ways.length > 0 && h("div", { class: "ways" }, "or the camera faces ", ...ways));
  };
  return h(
    "div",
    { class: "places" },
    h("h3", {}, "Possible places"),
    h("ol", {}, ...listed.map(row)),
    h(
      "ul",
      {},
      left !== null && h("li", { class: "rest" }, ...cells("", "other places of the plan", left)),
      elsewhere >= 0.005 && h("li", { class: "rest" }, ...cells("", nowhere, elsewhere)),
    ),
  );
}

function cells(rank: number | string, name: HTMLElement | string, share: number | null): HTMLElement[] {
  return [
    h("span", { class: "rank" }, rank),
    h("span", { class: "name" }, name),
    h("meter", { min: 0, max: 1, value: share ?? 0, "aria-hidden": "true" }),
    h("span", { class: "share" }, share === null ? "" : percent(share)),
  ];
}

/** Return a button for another heading at a place. */
function otherWay(answer: Answer, index: number, select: (index: number) => void): HTMLElement {
  const { heading_deg, probability } = answer.candidates[index]!;
  const share = probability === null ? "" : ` (${percent(probability)})`;
  const label = `${headingWords(heading_deg, null)}${share}`;
  return button(label, () => select(index), { "data-rank": index, "aria-pressed": "false" });
}

function facts(answer: Answer): HTMLElement {
  const stages = Object.entries(answer.timings_ms)
    .filter(([name, spent]) => name !== "total" && spent > 0)
    .map(([name, spent]) => `${name.replace("_", " ")} ${milliseconds(spent)}`);
  const plans = (answer.plans ?? [])
    .filter(({ probability }) => probability !== null)
    .slice(0, MAX_PLANS)
    .map((plan) => `${planLabel(plan)}: ${percent(plan.probability!)}`);
  const earth = answer.geopose?.position,
    source = HEADING_SOURCES[answer.heading_source] ?? HEADING_SOURCES.photograph;
  const pairs: [string, string][] = [
    ...(plans.length > 0 ? [["Plans", plans.join("; ")] as [string, string]] : []),
    ...(earth ? [["On Earth", `${earth.lat.toFixed(6)}, ${earth.lon.toFixed(6)}`] as [string, string]] : []),
    ["Heading", `${headingWords(answer.heading_deg, answer.heading_std_deg)}, ${source}`],
    ...(answer.view == null ? [] : [["Seen", seenWords(answer.view)] as [string, string]]),
    ["Camera height", `${answer.camera_height_m.toFixed(2)} m (best fit)`],
    ["Time", `${milliseconds(answer.timings_ms.total ?? 0)} (${stages.join(", ")})`],
    ["Method", `${STAGES[answer.stage]}, model ${answer.model.name} ${answer.model.version}`],
  ];
  return h(
    "details",
    { class: "how" },
    h("summary", {}, "How it was found"),
    h("dl", { class: "facts" }, ...pairs.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)])),
  );
}

function sharing(answer: Answer, photo: Photo | null, { save }: AnswerActions): HTMLElement {
  const files = (photo?.asked.files ?? []).map(({ name }) => name.replace(/^example-/, "examples/"));
  const onDevice = photo?.asked.onDevice ?? false,
    fields =
      photo?.asked.fields ??
      (answer.venue_id != null ? { venue_id: answer.venue_id } : { floorplan_id: answer.floorplan_id });
  const asked = { fields, files: files.length > 0 ? files : ["photo.jpg"], onDevice };
  return h(
    "div",
    { class: "sharing" },
    button("Copy as curl", () => void copy(curlSnippet(asked), "curl command"), { id: "copy-curl" }),
    button("Copy as Python", () => void copy(pythonSnippet(asked), "Python code"), { id: "copy-python" }),
    button("Save picture", () => void save(answer, photo), {
      id: "save-picture",
      title:
        photo === null
          ? "The plan with the place, as PNG"
          : "The photograph with the layout, and the plan with the place, as PNG",
    }),
    button("Copy link", () => void copyLink(answer), {
      id: "copy-link",
      title:
        answer.answer_id == null
          ? "The link contains this answer without the photograph; it opens as long as the plan is stored"
          : "Opens this answer again while the service stores it",
    }),
    h("pre", { class: "copied", id: "copied", tabindex: 0, hidden: true, "aria-label": "Copied text" }),
  );
}

const copyLink = (answer: Answer): Promise<void> =>
  attempt(byId("photo-error"), async () => copy(await linkTo(answer), "link"));

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
