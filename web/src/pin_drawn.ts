/** Elements that are made once and stay while what they show stays. */

import { show } from "./dom";

/** Element of a photograph, and a text of all that it shows. */
export type Drawn<E> = { key: string; element: E };

/** Replace the children of an element, unless they are the same: what is dragged or has the focus stays. */
export function keep(parent: Element, children: Element[]): void {
  const now = [...parent.children];
  if (now.length !== children.length || now.some((child, index) => child !== children[index]))
    show(parent, ...children);
}

/** Return the element of a photograph, made anew if it is to show something else. */
export function drawn<E>(known: Map<string, Drawn<E>>, id: string, shown: unknown, make: () => E): E {
  const key = JSON.stringify(shown);
  let found = known.get(id);
  if (found?.key !== key) known.set(id, (found = { key, element: make() }));
  return found.element;
}
