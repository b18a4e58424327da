/** Asks for the API key where the service wants one. */

import { key, onKeyNeeded } from "./api";
import { byId } from "./dom";

/** Connect the dialog; it opens by itself when the service refuses a request for want of a key. */
export function connectKeyDialog(): void {
  const dialog = byId<HTMLDialogElement>("key-dialog");
  const field = byId<HTMLInputElement>("key-field");
  const why = byId("key-why");
  const opener = byId<HTMLButtonElement>("key-button");
  let waiting: ((given: boolean) => void)[] = [];

  const showState = (): void => {
    opener.hidden = key.get() === null && opener.dataset.needed !== "yes";
  };
  const open = (text: string): void => {
    why.textContent = text;
    field.value = "";
    if (!dialog.open) dialog.showModal();
    field.focus();
  };
  onKeyNeeded((detail) => {
    opener.dataset.needed = "yes";
    open(key.get() === null ? "This service wants an API key." : `That key was refused: ${detail}`);
    return new Promise((resolve) => waiting.push(resolve));
  });
  opener.addEventListener("click", () => open("Another key takes the place of the one in use."));
  byId("key-cancel").addEventListener("click", () => dialog.close("cancel"));
  byId("key-forget").addEventListener("click", () => {
    key.forget();
    location.reload();
  });
  byId<HTMLFormElement>("key-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const given = field.value.trim();
    if (given === "") return;
    key.set(given);
    dialog.close("given");
  });
  dialog.addEventListener("close", () => {
    const given = dialog.returnValue === "given";
    const asked = waiting;
    waiting = [];
    asked.forEach((resolve) => resolve(given));
    showState();
    if (given && asked.length === 0) location.reload();
    dialog.returnValue = "";
  });
  showState();
}
