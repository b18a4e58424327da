/** Guide of three steps on the first visit. */

import { byId } from "./dom";

const SEEN = "lalaloc-guide";

/** Show the guide unless it was hidden before. */
export function connectGuide(): void {
  byId("guide").hidden = localStorage.getItem(SEEN) !== null;
  byId("guide-hide").addEventListener("click", hideGuide);
}

/** Hide the guide for good, as after the first answer. */
export function hideGuide(): void {
  byId("guide").hidden = true;
  localStorage.setItem(SEEN, "hidden");
}
