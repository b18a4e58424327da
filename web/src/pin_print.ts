/** Pages for paper: the plans with numbered pins, then a page per room with its photographs, dates and arrows. */

import { h, s, show } from "./dom";
import { factsOf, shotOf } from "./pin_card";
import type { Floors, Row } from "./pin_floors";
import type { Thumbnail } from "./pin_photographs";
import { boxOf, drawNames, drawPlan, lostAreas } from "./plan_drawing";

/** Fill an element with the pages. */
export function showPages(
  place: Element,
  title: string,
  rows: Row[],
  floors: Floors,
  thumbnails: ReadonlyMap<string, Thumbnail>,
  height: number | null,
  pinsOf: (rows: Row[], planId: string) => Element[],
): void {
  const card = (row: Row): HTMLElement =>
    h(
      "li",
      {},
      shotOf(row, thumbnails.get(row.id) ?? null, floors, height),
      h("p", {}, arrowOf(row), h("strong", {}, ` ${row.number} ${row.name ?? ""}`)),
      h("p", {}, [row.view.taken_at?.replace("T", " ").slice(0, 16), factsOf(row)].filter(Boolean).join(" · ")),
    );
  const drawing = (planId: string, shown: Row[]): Element | null => {
    const floor = floors.get(planId);
    if (floor === null) return null;
    const lost = lostAreas(floor.plan),
      box = boxOf(floor.plan.plan, lost);
    const [base, names, pins] = [s("g"), s("g"), s("g")];
    drawPlan(base, floor.plan.plan, lost);
    drawNames(names, floor.plan.plan, box, lost);
    show(pins, ...pinsOf(shown, planId));
    return s("svg", { viewBox: `${box.x} ${box.y} ${box.width} ${box.height}`, class: "plan" }, base, names, pins);
  };
  const page = (heading: string, ...content: (Element | null)[]): HTMLElement =>
    h("section", { class: "page" }, h("h2", {}, heading), ...content);
  const byRoom = new Map<string, Row[]>(),
    plans = new Set<string>();
  for (const row of rows) {
    if (!row.pin?.place) continue;
    plans.add(row.pin.place.floorplan_id);
    const key = `${row.pin.place.floorplan_id}/${row.pin.place.room_id}`;
    byRoom.set(key, [...(byRoom.get(key) ?? []), row]);
  }
  const aside = rows.filter(({ pin }) => !pin?.place);
  show(
    place,
    ...[...plans].map((id) =>
      page(floors.venue === null ? title : (floors.get(id)?.plan.name ?? title), drawing(id, rows)),
    ),
    ...[...byRoom.values()].map((members) => {
      const { room, floorplan_id: id } = members[0]!.pin!.place!;
      return page(room, drawing(id, members), h("ul", {}, ...members.map(card)));
    }),
    aside.length > 0 && page("Set aside", h("ul", {}, ...aside.map(card))),
  );
}

function arrowOf({ pin }: Row): SVGElement | null {
  const heading = pin?.place?.heading_deg ?? null;
  if (heading === null) return null;
  return s(
    "svg",
    { viewBox: "-6 -6 12 12", class: "arrow", "aria-hidden": true },
    s("path", { d: "M-3 4L0 -5L3 4L0 2Z", transform: `rotate(${heading})` }),
  );
}
