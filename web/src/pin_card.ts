/** Card of a photograph: its pin in words, the walls drawn over it, and other places to choose from. */

import { throughCamera } from "./camera";
import { button, h, s } from "./dom";
import { degrees, layoutLines, radians } from "./layout";
import type { Floors, PinnedAt, Row } from "./pin_floors";
import type { Thumbnail } from "./pin_photographs";
import { folderWords, percent } from "./plain_words";
import { equirectangular } from "./projection";
import type { Point } from "./types";

export interface CardActions {
  /** `isKey`: by the keyboard, after which the next uncertain photograph is wanted. */
  choose(row: Row, place: PinnedAt, isKey: boolean): void;
  elsewhere(row: Row, isKey: boolean): void;
  confirm(row: Row, isKey: boolean): void;
  restore(row: Row): void;
  /** The card has got the focus. */
  show(row: Row): void;
}

const WIDTH = 400;

/** Return the number of photographs whose place is sure. */
export const sureOf = (rows: Row[]): number =>
  rows.filter(({ pin }) => pin?.state === "sure" || pin?.state === "corrected").length;

/** Return the words on a pin. */
export function factsOf({ pin }: Row): string {
  if (pin === null) return "Waiting for its pin";
  const reason = pin.reason === "" ? "" : `: ${pin.reason}`;
  if (pin.place === null) return `Set aside${reason}`;
  const shares = `${percent(pin.room_confidence)}, within 1 m ${percent(pin.within_1m)}`;
  return `${pin.place.room}, ${pin.state === "corrected" ? "corrected" : shares}${reason}`;
}

/** Return what a new revision of the plan changed about a pin; null if nothing. */
export function movedOf({ number, name, pin }: Row): string | null {
  if (!pin?.moved) return null;
  const { before, distance_m: distance, new_room: isNew } = pin.moved;
  const way = distance === null ? "" : `${distance.toFixed(1)} m away`;
  const rooms = isNew ? `${before?.room ?? "set aside"} → ${pin.place?.room ?? "set aside"}` : (pin.place?.room ?? "");
  return `${number} ${name ?? ""}: ${[rooms, way].filter(Boolean).join(", ")}`;
}

/** Return a photograph with the walls over it that are seen from its pin, or from another place by `draw`. */
export function shotOf(row: Row, picture: Thumbnail | null, floors: Floors, height: number | null) {
  if (picture === null)
    return Object.assign(h("div", { class: "shot none" }, "No preview"), {
      draw: (_: PinnedAt | null): void => undefined,
    });
  const size = { width: WIDTH, height: WIDTH * picture.shape };
  const over = s("svg", { viewBox: `0 0 ${size.width} ${size.height}`, "aria-hidden": true });
  const draw = (at: PinnedAt | null): void => {
    const room = at && floors.room(at);
    if (!at || !room || at.heading_deg === null) return over.replaceChildren();
    const turn = radians(at.heading_deg),
      height_m = height ?? floors.get(at.floorplan_id)?.plan.plan.camera_height_m ?? 1.5;
    const lines = layoutLines(at.position.x_m, at.position.y_m, room, height_m).map(({ points }) =>
      points.map(([azimuth, elevation]): Point => [radians(((degrees(azimuth - turn) + 540) % 360) - 180), elevation]),
    );
    const isSphere = row.view.projection === "equirectangular";
    const drawn = lines.flatMap((line) =>
      isSphere ? equirectangular(line, size) : throughCamera(line, row.view, size),
    );
    const d = drawn.map((line) => `M${line.map((point) => point.join(" ")).join("L")}`).join("");
    over.replaceChildren(s("path", { class: "dark", d }), s("path", { d }));
  };
  draw(row.pin?.place ?? null);
  const element = h("div", { class: "shot" }, h("img", { src: picture.url, alt: "", loading: "lazy" }), over);
  return Object.assign(element, { draw });
}

export function cardOf(row: Row, picture: Thumbnail | null, floors: Floors, height: number | null, act: CardActions) {
  const { pin } = row,
    place = pin?.place ?? null;
  const shot = shotOf(row, picture, floors, height);
  const isOpen = pin !== null && pin.state !== "corrected" && row.correction === null;
  const choices = isOpen ? pin.suggestions : [];
  const preview = (at: PinnedAt | null) => (): void => shot.draw(at);
  const suggestions = (): HTMLElement =>
    h(
      "div",
      { class: "choices" },
      ...choices.map((suggestion, index) =>
        h(
          "button",
          {
            type: "button",
            id: `choice-${row.number}-${index}`,
            "aria-label": `${index + 1}: ${suggestion.room}, ${percent(suggestion.probability)}`,
            onclick: () => act.choose(row, suggestion, false),
            onpointerenter: preview(suggestion),
            onpointerleave: preview(place),
            onfocus: preview(suggestion),
            onblur: preview(place),
          },
          floors.smallPlan(suggestion),
          h("span", {}, h("kbd", {}, index + 1), ` ${suggestion.room} ${percent(suggestion.probability)}`),
        ),
      ),
    );
  // Small plans of hundreds of sure photographs would take seconds.
  const onOpen = (event: Event): void => {
    const details = event.currentTarget as HTMLElement;
    if (details.childElementCount === 1) details.append(suggestions());
  };
  // The first one of a sure pin is its own place.
  const others =
    choices.length > (pin?.state === "uncertain" ? 0 : 1) &&
    (pin?.state === "uncertain" ? suggestions() : h("details", { ontoggle: onOpen }, h("summary", {}, "Other places")));
  const label = `Photograph ${row.number}, ${row.name ?? ""}: ${factsOf(row)}`;
  const onkeydown = ((event: KeyboardEvent) => {
    if (!isOpen || event.ctrlKey || event.metaKey || event.altKey) return;
    const chosen = choices[Number(event.key) - 1];
    if (chosen) act.choose(row, chosen, true);
    else if (event.key === "0") act.elsewhere(row, true);
    else if (event.key === "Enter" && event.target === event.currentTarget && place) act.confirm(row, true);
    else return;
    event.preventDefault();
  }) as EventListener;
  const card = h(
    "div",
    { class: "card", id: `card-${row.number}`, tabindex: 0, role: "group", "aria-label": label, onkeydown },
    shot,
    h(
      "div",
      {},
      h("strong", { class: "name" }, `${row.number} ${row.name ?? ""}`),
      h("p", {}, factsOf(row)),
      h("p", { class: "hint" }, row.view.taken_at?.replace("T", " ").slice(0, 16)),
    ),
    others,
    h(
      "div",
      { class: "acts" },
      isOpen && place && button("Right", () => act.confirm(row, false), { id: `right-${row.number}` }),
      isOpen && button("Elsewhere", () => act.elsewhere(row, false), { id: `elsewhere-${row.number}` }),
      row.correction !== null && button("Remove the correction", () => act.restore(row)),
    ),
  );
  card.addEventListener("focusin", () => act.show(row));
  return h("li", { class: pin?.state ?? "waiting" }, card);
}

/** Return the warnings about photographs, each cause once: its texts differ in numbers only. */
export function warningsOf(rows: Row[]): string[] {
  const causes = new Map<string, { named: string; text: string; more: number }>();
  for (const { number, name, pin } of rows)
    for (const text of (pin?.warnings ?? []).map(folderWords)) {
      const cause = text.replace(/\d+(\.\d+)?/g, "#"),
        known = causes.get(cause);
      if (known === undefined) causes.set(cause, { named: `${number} ${name ?? ""}`, text, more: 0 });
      else known.more++;
    }
  return [...causes.values()].map(({ named, text, more }) => `${named}${more > 0 ? ` and ${more} more` : ""}: ${text}`);
}

/** Mark the pin and the card of a photograph, by its number, as the current ones. */
export function markCurrent(number: number): void {
  for (const element of document.querySelectorAll(".current")) element.classList.remove("current");
  for (const id of [`pin-${number}`, `card-${number}`]) document.getElementById(id)?.classList.add("current");
}
