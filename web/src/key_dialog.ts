/** Dialog for the API key. */

import { key, onKeyNeeded } from "./api";
import { button, byId, h } from "./dom";

/** Connect the dialog, which opens when the service refuses a request without a valid key. */
export function connectKeyDialog(): void {
  const reason = h("p", { id: "key-why" });
  const field = h("input", {
    id: "key-field",
    type: "password",
    autocomplete: "off",
    spellcheck: "false",
    placeholder: "lalaloc_…",
    required: true,
  });
  const form = h(
    "form",
    {},
    h("h2", { id: "key-title" }, "API key"),
    reason,
    h("label", { for: field.id }, "Key"),
    field,
    h("p", { class: "hint" }, "The key is kept in this tab until the tab is closed."),
    h(
      "div",
      { class: "ask" },
      h("button", { class: "primary" }, "Use this key"),
      button("Remove the key", () => {
        key.remove();
        location.reload();
      }),
      button("Cancel", () => dialog.close("cancel")),
    ),
  );
  const dialog = h("dialog", { id: "key-dialog", "aria-labelledby": "key-title" }, form);
  document.body.append(dialog);
  const opener = byId<HTMLButtonElement>("key-button");
  let waiting: ((given: boolean) => void)[] = [];

  const showState = (): void => {
    opener.hidden = key.get() === null && opener.dataset.needed !== "yes";
  };
  const open = (text: string): void => {
    reason.textContent = text;
    field.value = "";
    if (!dialog.open) dialog.showModal();
    field.focus();
  };
  onKeyNeeded(({ detail }) => {
    opener.dataset.needed = "yes";
    open(key.get() === null ? "This service requires an API key." : refusalWords(detail));
    return new Promise((resolve) => waiting.push(resolve));
  });
  opener.addEventListener("click", () => open("A new key replaces the current one."));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const given = field.value.trim();
    if (given === "") return;
    key.set(given);
    dialog.close("given");
  });
  dialog.addEventListener("close", () => {
    const given = dialog.returnValue === "given";
    const resolvers = waiting;
    waiting = [];
    resolvers.forEach((resolve) => resolve(given));
    showState();
    if (given && resolvers.length === 0) location.reload();
    dialog.returnValue = "";
  });
  showState();
}

/** Say why a key was refused: the service tells its holder when it expired. */
function refusalWords(detail: string): string {
  const expired = /expired at (\S+Z)/.exec(detail)?.[1];
  if (expired === undefined) return "This key is not valid. Enter another one.";
  const date = new Date(expired).toLocaleString("en-GB", { dateStyle: "long", timeStyle: "short" });
  return `This key expired on ${date}. Enter its successor, or ask the operator for one.`;
}
