/** Creation of elements. Styles are classes or CSSOM: the page's content security policy forbids inline styles. */

type Child = Node | string | number | null | undefined | false;
type Attributes = Record<string, string | number | boolean | null | undefined | EventListener>;

const SVG = "http://www.w3.org/2000/svg";

function fill<E extends Element>(element: E, attributes: Attributes, children: Child[]): E {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...present(children));
  return element;
}

// The DOM turns numbers into text.
function present(children: Child[]): (Node | string)[] {
  return children.filter((child) => child !== null && child !== undefined && child !== false) as (Node | string)[];
}

/** Create an HTML element; attributes that begin with "on" are listeners. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  return fill(document.createElement(tag), attributes, children);
}

export function s<K extends keyof SVGElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  return fill(document.createElementNS(SVG, tag) as SVGElementTagNameMap[K], attributes, children);
}

export function byId<T extends Element = HTMLElement>(id: string): T {
  const element = document.getElementById(id);
  if (element === null) throw new Error(`the page has no #${id}`);
  return element as Element as T;
}

/** Return the id of some kind that the page's address names, as in `#answer=…`. */
export const named = (kind: string): string | null => new URLSearchParams(location.hash.slice(1)).get(kind);

/** Replace the children of an element. */
export function show(element: Element, ...children: Child[]): void {
  element.replaceChildren(...present(children));
}

/** Replace the children of an element; the focus goes from one of them to the new one with its id. */
export function showKeepingFocus(element: Element, ...children: Child[]): void {
  const focused = element.contains(document.activeElement) ? document.activeElement!.id : "";
  show(element, ...children);
  if (focused !== "") document.getElementById(focused)?.focus({ preventScroll: true });
}

/** Unit vectors of the arrow keys, with y up. */
export const ARROWS: Record<string, [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

/** Call `move` for every movement of the pointer until it is released, and then `done`. */
export function followPointer(move: (event: PointerEvent) => void, done?: () => void): void {
  const end = (): void => {
    removeEventListener("pointermove", move);
    removeEventListener("pointerup", end);
    removeEventListener("pointercancel", end);
    done?.();
  };
  addEventListener("pointermove", move);
  addEventListener("pointerup", end);
  addEventListener("pointercancel", end);
}

/** Scroll as little as needed to see an element, or its beginning if it is higher than the window. */
export function scrollTo(element: HTMLElement): void {
  // The nearest edge of a higher element is its lower one.
  element.scrollIntoView({ block: element.offsetHeight > innerHeight ? "start" : "nearest" });
}

/** Show a dialog of the page; return whether it is closed by the button with a value. */
export function confirmed(id: string, value: string): Promise<boolean> {
  const dialog = byId<HTMLDialogElement>(id);
  dialog.showModal();
  return new Promise((resolve) => {
    const onClose = (): void => {
      resolve(dialog.returnValue === value);
      dialog.returnValue = "";
    };
    dialog.addEventListener("close", onClose, { once: true });
  });
}

/** Offer a file for download. */
export function download(content: Blob, name: string): void {
  const url = URL.createObjectURL(content);
  const link = h("a", { href: url, download: name });
  link.click();
  // The download has begun by then.
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

/** Create a button with a text, or with several children. */
export function button(label: string | Child[], act: () => void, attributes: Attributes = {}): HTMLButtonElement {
  const children = typeof label === "string" ? [label] : label;
  return h("button", { type: "button", ...attributes, onclick: () => act() }, ...children);
}

/** Create a button of the list of plans, or of venues. */
export function planButton(name: string, facts: string, isChosen: boolean, choose: () => void): HTMLButtonElement {
  const parts = [h("span", { class: "name" }, name), h("span", { class: "facts" }, facts)];
  return button(parts, choose, { class: "plan", "aria-pressed": String(isChosen) });
}
