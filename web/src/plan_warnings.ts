/** Warnings about the plan that is shown. */

import { byId, h, show } from "./dom";
import { plainWords } from "./plain_words";
import type { Plan } from "./types";

const DRAFT =
  "This plan is a draft, derived from a picture or from lines: check it, and correct it with “Edit”. When all doors or " +
  "all windows are right, tick them in the editor: only then the search uses them.";
const MAX_WARNINGS = 4;

/** Show the warnings about a plan; the rest of a long list opens with a click. */
export function showWarnings(plan: Plan | null): void {
  const report = plan?.import_report;
  const texts = [...(report?.is_draft ? [DRAFT] : []), ...(plan?.warnings ?? []), ...(report?.unsure ?? [])];
  const items = texts.map((text) => h("li", {}, plainWords(text)));
  const rest = items.splice(MAX_WARNINGS);
  show(
    byId("plan-warnings"),
    ...items,
    rest.length > 0 && h("li", {}, h("details", {}, h("summary", {}, `${rest.length} more`), h("ul", {}, ...rest))),
  );
}
