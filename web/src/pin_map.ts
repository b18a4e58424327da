/** Pins on the plan: dragged or moved by arrow keys; arrows are turned at their tips or by Page Up and Page Down. */

import { ARROWS, followPointer, s } from "./dom";
import { degrees } from "./layout";
import type { Row } from "./pin_floors";
import { percent } from "./plain_words";
import { placeOf } from "./pose_marker";
import type { Point } from "./types";

const STEP_M = 0.25;
const TURN_DEG = 15;
// Distance of the centres of pins that do not cover each other, in radii, and most steps to reach it.
const GAP = 2.3;
const MAX_ROUNDS = 100;

export interface PinActions {
  move(row: Row, position: Point, heading_deg: number | null): void;
  /** The pin has got the focus. */
  show(row: Row): void;
}

/** Return where pins with places are drawn: those that would cover others, such as of a turn, are pushed aside. */
export function fanned(rows: Row[], radius: number): Point[] {
  const seen = rows.map(({ pin }): Point => [pin!.place!.position.x_m, pin!.place!.position.y_m]);
  for (let round = 0, isClear = false; round < MAX_ROUNDS && !isClear; round++) {
    isClear = true;
    seen.forEach((a, i) => {
      for (const b of seen.slice(0, i)) {
        const [x, y] = [a[0] - b[0], a[1] - b[1]],
          near = GAP * radius - Math.hypot(x, y);
        if (near <= 0) continue;
        // Those of one spot have directions of their own.
        const turn = x === 0 && y === 0 ? i : Math.atan2(y, x);
        const [dx, dy] = [0.5 * near * Math.cos(turn), 0.5 * near * Math.sin(turn)];
        [a[0], a[1], b[0], b[1]] = [a[0] + dx, a[1] + dy, b[0] - dx, b[1] - dy];
        isClear &&= near < 0.1 * radius;
      }
    });
  }
  return seen;
}

/** Return the pin of a photograph, drawn at a point with a radius (m); without actions, for paper. */
export function pinOf(row: Row, seen: Point, radius: number, svg: SVGSVGElement, act: PinActions | null) {
  const place = row.pin?.place;
  if (!place) return null;
  const { x_m, y_m } = place.position,
    heading = place.heading_deg;
  const tip = `M${-0.8 * radius} ${-0.7 * radius}L0 ${-2.4 * radius}L${0.8 * radius} ${-0.7 * radius}Z`;
  const arrow = heading === null ? null : s("path", { class: "arrow", d: tip, transform: `rotate(${heading})` });
  const label = `Photograph ${row.number}, ${place.room}, ${row.pin!.state}, ${percent(row.pin!.room_confidence)}`;
  const roles = act === null ? {} : { id: `pin-${row.number}`, tabindex: 0, role: "button", "aria-label": label };
  const pin = s(
    "g",
    { class: `pin ${row.pin!.state}`, ...roles },
    s("line", { class: "stem", x2: x_m - seen[0], y2: seen[1] - y_m }),
    arrow,
    s("circle", { r: radius, "stroke-width": 0.3 * radius }),
    s("text", { y: 0.38 * radius, "font-size": (row.number < 100 ? 1.1 : 0.8) * radius }, row.number),
  );
  const put = ([x, y]: Point): void => pin.setAttribute("transform", `translate(${x} ${-y})`);
  put(seen);
  if (act === null) return pin;
  const follow = (begin: PointerEvent, moved: (at: Point) => void, done: () => void): void => {
    begin.preventDefault();
    begin.stopPropagation();
    pin.focus();
    followPointer((event) => moved(placeOf(svg, event)), done);
  };
  pin.addEventListener("pointerdown", (event) => {
    let target: Point | null = null;
    follow(
      event,
      (at) => put((target = at)),
      () => target && act.move(row, target, heading),
    );
  });
  arrow?.addEventListener("pointerdown", (event) => {
    let turned: number | null = null;
    follow(
      event as PointerEvent,
      ([x, y]) => {
        turned = (degrees(Math.atan2(x - seen[0], y - seen[1])) + 360) % 360;
        arrow.setAttribute("transform", `rotate(${turned})`);
      },
      () => turned !== null && act.move(row, [x_m, y_m], turned),
    );
  });
  pin.addEventListener("keydown", (event) => {
    const step = ARROWS[event.key];
    if (step) act.move(row, [x_m + STEP_M * step[0], y_m + STEP_M * step[1]], heading);
    else if (event.key === "PageUp" || event.key === "PageDown")
      act.move(row, [x_m, y_m], ((heading ?? 0) + (event.key === "PageUp" ? TURN_DEG : 360 - TURN_DEG)) % 360);
    else return;
    event.preventDefault();
  });
  pin.addEventListener("focus", () => act.show(row));
  return pin;
}
