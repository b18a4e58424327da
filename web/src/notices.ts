/** Errors where they happen: in plain words, at the field that is at fault. */

import { Refusal } from "./api";
import { h, show } from "./dom";

/** Show what went wrong in an element with the role alert, and mark the fields that it is about. */
export function showError(place: HTMLElement, error: unknown, fields: Record<string, HTMLElement> = {}): void {
  clearError(place, fields);
  const refusal = error instanceof Refusal ? error : null;
  const text = error instanceof Error ? error.message : String(error);
  const faults = refusal?.faults ?? [];
  show(place,
    h("strong", {}, refusal?.title ?? "Something went wrong"),
    h("p", {}, plain(refusal) ?? refusal?.detail ?? text),
    faults.length > 0 && h("ul", {}, ...faults.map((fault) => h("li", {}, h("code", {}, fault.field), ` ${fault.message}`))),
    refusal?.retryAfterS ? h("p", {}, `Try again in ${refusal.retryAfterS} s.`) : null);
  place.hidden = false;
  place.scrollIntoView({ block: "nearest" });
  for (const fault of faults) {
    const field = fields[fault.field];
    if (field === undefined) continue;
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", place.id);
  }
}

/** Take an error away, and its marks. */
export function clearError(place: HTMLElement, fields: Record<string, HTMLElement> = {}): void {
  place.hidden = true;
  show(place);
  for (const field of Object.values(fields)) {
    field.removeAttribute("aria-invalid");
    field.removeAttribute("aria-describedby");
  }
}

/** For what people run into by pressing buttons; the service's own words are for whoever writes the request. */
function plain(refusal: Refusal | null): string | null {
  if (refusal === null) return null;
  const words: Record<string, string> = {
    "insufficient-scope": "Your API key is not good for this. Ask for one that is, or use another with the button “API key”.",
    overloaded: "The service has too much to do at the moment.",
    "plan-not-ready": "The plan is still being prepared. Wait until its bar is full, then ask again.",
  };
  const said = words[refusal.slug];
  return said === undefined ? null : `${said} (${refusal.detail})`;
}

let hide: number | undefined;

/** A short message at the bottom of the page that screen readers tell, too. */
export function say(text: string): void {
  const place = document.getElementById("toast");
  if (place === null) return;
  place.textContent = text;
  place.classList.add("shown");
  clearTimeout(hide);
  hide = window.setTimeout(() => place.classList.remove("shown"), 4000);
}
