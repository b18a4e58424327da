/** Caption of the plan that is shown: name, facts, progress and warnings. */

import { byId, h, show } from "./dom";
import { InputError, showError } from "./notices";
import { plainWords } from "./plain_words";
import type { Plan, PlanDocument, PlanSummary } from "./types";

const DRAFT =
  "This plan is a draft, derived from a picture or from lines: check it, and correct it with “Edit”. When all doors or " +
  "all windows are right, tick them in the editor: the search then relies on them in full.";
const MAX_WARNINGS = 4;

/** Describe a stored plan, or the example before it is stored; null: no plan is shown. */
export function showCaption(plan: Plan | null, example: PlanDocument | null = null): void {
  byId("plan-name").textContent = plan?.name ?? example?.name ?? "No plan chosen";
  const facts = plan && `${plan.rooms.length} rooms, ${plan.area_m2.toFixed(1)} m², revision ${plan.revision_number}`;
  byId("plan-facts").textContent = facts ?? (example === null ? "" : "example, stored with the first query");
  byId("preparing").hidden = plan?.status !== "preparing";
  byId<HTMLProgressElement>("plan-progress").value = plan?.progress ?? 0;
  byId<HTMLButtonElement>("edit-plan").disabled = plan === null;
  if (plan?.status === "failed")
    showError(byId("plan-error"), new InputError(`The plan could not be prepared: ${plan.reason}`));
  showWarnings(plan);
}

type Stored = Pick<PlanSummary, "name" | "updated_at"> & { revision_number?: number };

/** Tell a plan or venue from others of its name in a list by its last change; "" if no other has its name. */
export function storedAs({ name, updated_at, revision_number: revision }: Stored, listed: Stored[]): string {
  if (listed.filter((other) => other.name === name).length < 2) return "";
  const date = new Date(updated_at).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "medium" });
  return `stored ${date}${revision === undefined ? "" : `, revision ${revision}`}`;
}

/** Return the name of a plan or venue in a list, with its last change if others have it. */
export const nameIn = (place: Stored, all: Stored[]) => [place.name, storedAs(place, all)].filter(Boolean).join(", ");

/** Show the warnings about a plan; the rest of a long list opens with a click. */
function showWarnings(plan: Plan | null): void {
  const report = plan?.import_report;
  // An assumed ceiling is a warning of the plan and a guess of the import.
  const texts = [
    ...(report?.is_draft ? [DRAFT] : []),
    ...(plan?.warnings ?? []),
    ...(report?.unsure ?? []),
    ...(report?.rejected_texts ?? []),
  ];
  // Texts that differ in numbers alone have one cause.
  const causes = new Map<string, Set<string>>();
  for (const text of texts) {
    const cause = text.replace(/\d+(\.\d+)?/g, "#");
    causes.set(cause, (causes.get(cause) ?? new Set()).add(text));
  }
  const list = (items: (HTMLElement | string)[]): HTMLElement[] => items.map((item) => h("li", {}, item));
  const folded = (summary: string, items: (HTMLElement | string)[]): HTMLElement | false =>
    items.length > 0 && h("details", {}, h("summary", {}, summary), h("ul", {}, ...list(items)));
  const items = [...causes.values()].map((alike) => {
    const [first, ...others] = [...alike].map(plainWords);
    return h("div", {}, first, folded(`${others.length} more of this kind`, others));
  });
  const rest = folded(`${items.length - MAX_WARNINGS} more`, items.splice(MAX_WARNINGS));
  show(byId("plan-warnings"), ...list(items), rest && h("li", {}, rest));
}
