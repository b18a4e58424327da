/** Connection of the pages to their service: the client of `clients/typescript`, with the API key of this tab. */

import { Client, type ServiceError } from "../../clients/typescript/src/index";
import { named } from "./dom";

export { ServiceError } from "../../clients/typescript/src/index";

const KEY = "lalaloc-key";

/** API key, kept until the tab is closed; `inLinks` is the part of links that passes on the key of the page's own. */
export const key = {
  get: (): string | null => sessionStorage.getItem(KEY),
  set: (value: string): void => sessionStorage.setItem(KEY, value),
  remove: (): void => sessionStorage.removeItem(KEY),
  inLinks: (): string => sessionStorage.getItem("lalaloc-in-links") ?? "",
};

// As in the link of `lalaloc-service serve --lan`. Not at names: somebody's link would store plans with somebody's key.
const linked = named("key");
if (linked !== null && /^[\d.]+$/.test(location.hostname)) {
  key.set(linked);
  sessionStorage.setItem("lalaloc-in-links", `&key=${linked}`);
  history.replaceState(null, "", location.href.replace(`key=${linked}`, ""));
}

type AskForKey = (failure: ServiceError) => Promise<boolean>;
let askForKey: AskForKey = async () => false;

/** Register the dialog that asks for a key; its promise is false if the user gives none. */
export function onKeyNeeded(ask: AskForKey): void {
  askForKey = ask;
}

// A user waits for each request, so overload is reported early.
export const api = new Client({
  apiKey: key.get,
  onUnauthenticated: (failure) => askForKey(failure),
  attempts: 3,
  retryMs: 10_000,
});
