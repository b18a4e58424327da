/** Messages: errors next to the fields that cause them, and short notices. */

import { ServiceError } from "./api";
import { byId, h, show } from "./dom";
import { InputError } from "./input_error";
import { labelOf, plainWords } from "./plain_words";

export { InputError };

// Plain words by the slugs of frequent errors; the service's own messages are written for developers.
const PLAIN_TEXTS: Record<string, string> = {
  "insufficient-scope": "Your API key lacks the required scope. Choose another key with the button “API key”.",
  "foreign-features": "The service has another model than this page has loaded. Load the page again.",
  "features-required":
    "This service takes no photographs. Load the page again: it then computes features in the browser.",
  overloaded: "The service is overloaded.",
  "floorplan-unanchored":
    "The plan’s place on Earth is unknown: give it on the first page by “Edit”, “Place on Earth”.",
  "unknown-album": "The folder is no longer stored. Choose its plan, and add the photographs again.",
  "plan-not-ready": "The plan is still being prepared. Try again when the progress bar is full.",
};

type Fields = Record<string, HTMLElement>;

/** Do some work; show its error in an element, and mark the fields that cause it. */
export async function attempt(place: HTMLElement, work: () => Promise<unknown>, fields: Fields = {}): Promise<void> {
  clearError(place, fields);
  try {
    await work();
  } catch (error) {
    showError(place, error, fields);
  }
}

/** Show an error in an element with the role alert and mark the fields that cause it. */
export function showError(place: HTMLElement, error: unknown, fields: Fields = {}): void {
  clearError(place, fields);
  const failure = error instanceof ServiceError ? error : null;
  const text = error instanceof Error ? error.message : String(error);
  const faults = failure?.faults ?? [];
  const title = failure?.title ?? (error instanceof InputError ? null : "Something went wrong");
  const plain = PLAIN_TEXTS[failure?.slug ?? ""],
    detail = plainWords(failure?.detail ?? text);
  show(
    place,
    title !== null && h("strong", {}, plainWords(title)),
    h("p", {}, plain ? `${plain} (${detail})` : detail),
    faults.length > 0 &&
      h(
        "ul",
        {},
        ...faults.map((fault) => h("li", {}, h("strong", {}, labelOf(fault.field)), ` ${plainWords(fault.message)}`)),
      ),
    failure?.retryAfterS ? h("p", {}, `Try again in ${failure.retryAfterS} s.`) : null,
  );
  place.hidden = false;
  place.scrollIntoView({ block: "nearest" });
  for (const fault of faults) {
    const field = fields[fault.field];
    if (field !== undefined) markInvalid(field, place);
  }
}

/** Mark a field as the cause of an error, and unfold the forms around it. */
function markInvalid(field: HTMLElement, place: HTMLElement): void {
  field.setAttribute("aria-invalid", "true");
  field.setAttribute("aria-describedby", place.id);
  for (let fold = field.closest("details"); fold !== null; fold = fold.parentElement?.closest("details") ?? null)
    fold.open = true;
}

/** Show an error beside the one field that causes it. */
export function showFieldError(place: HTMLElement, field: HTMLElement, text: string): void {
  place.textContent = text;
  place.hidden = false;
  markInvalid(field, place);
  field.focus();
}

/** Remove an error and its marks. */
export function clearError(place: HTMLElement, fields: Fields = {}): void {
  place.hidden = true;
  show(place);
  for (const field of Object.values(fields)) {
    field.removeAttribute("aria-invalid");
    field.removeAttribute("aria-describedby");
  }
}

/** Remove all errors after something worked: they are about what the user did before. */
export function clearErrors(): void {
  for (const place of document.querySelectorAll<HTMLElement>(".error:not([hidden])")) {
    const marked = document.querySelectorAll<HTMLElement>(`[aria-describedby="${place.id}"]`);
    clearError(place, Object.fromEntries([...marked].entries()));
  }
}

let hide: number | undefined;

/** Show a short notice at the bottom of the page. */
export function say(text: string): void {
  const place = byId("toast");
  place.textContent = text;
  place.classList.add("shown");
  clearTimeout(hide);
  // Long ones stay as long as they take to read.
  hide = window.setTimeout(() => place.classList.remove("shown"), Math.max(4000, 60 * text.length));
}

/** Take a comma for the decimal point in fields for numbers, where browsers of some languages drop it; tell what is no number. */
export function connectNumbers(): void {
  addEventListener("beforeinput", (event) => {
    const isNumber = (event.target as Element).matches("[type=number]");
    if (!isNumber || !/^[^.,]*,[^.,]*$/.test(event.data ?? "")) return;
    event.preventDefault();
    document.execCommand("insertText", false, event.data!.replace(",", "."));
  });
  addEventListener("focusout", ({ target: field }) => {
    if (field instanceof HTMLInputElement && field.validity.badInput) say(field.validationMessage);
  });
}
