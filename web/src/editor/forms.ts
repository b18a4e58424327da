/** Forms for the properties of a room, an opening or the whole plan. */

import { button, h, show } from "../dom";
import { say } from "../notices";
import type { AnchorDocument, OpeningDocument, OpeningKind, PlanDocument, RoomDocument } from "../types";
import * as change from "./changes";
import type { EditActions, Selection } from "./handles";

type RoomType = NonNullable<RoomDocument["type"]>;
type Value = number | null | undefined;

const ROOM_TYPES: RoomType[] = [
  "unknown",
  "bedroom",
  "living",
  "kitchen",
  "dining",
  "bathroom",
  "corridor",
  "entrance",
  "closet",
  "storage",
  "laundry",
  "garage",
  "stairs",
  "balcony",
  "office",
  "meeting",
];
// Height (m) that the service assumes for plans without one, as a field shows it.
const ASSUMED = "2.5 assumed";
// Between the numbers of a place, as maps and tables give them.
const SEPARATORS = /[\s,;]+/;
const PLACES = "latitude, longitude of x 0, y 0, or x, y, latitude, longitude of two points";
// Rooms that a hint names.
const MAX_NAMED = 6;
const OPENING_KINDS: OpeningKind[] = ["door", "window", "passage"];

let later: number | undefined;

export function showForm(place: HTMLElement, plan: PlanDocument, selection: Selection, actions: EditActions): void {
  const draw = (): void => {
    const room = selection.kind === "room" ? plan.rooms[selection.index] : undefined;
    const opening = selection.kind === "opening" ? plan.openings?.[selection.index] : undefined;
    if (room !== undefined && selection.kind === "room") show(place, ...roomForm(room, selection.index, actions));
    else if (opening !== undefined && selection.kind === "opening")
      show(place, ...openingForm(opening, selection.index, actions));
    else show(place, ...planForm(plan, actions));
  };
  const isTyping = (): boolean => place.contains(document.activeElement?.closest("input, select") ?? null),
    of = JSON.stringify(selection);
  clearTimeout(later);
  if (place.dataset.of !== of || !place.hasChildNodes()) draw();
  // A field that is left changes the plan before the next one has the focus; that shows what is typed.
  else later = window.setTimeout(() => place.hasChildNodes() && !isTyping() && draw());
  place.dataset.of = of;
}

let current: PlanDocument = { rooms: [] };

/** Set the plan that forms change: the current one when a field is left, not when the form was created. */
export function setFormPlan(plan: PlanDocument): void {
  current = plan;
}

function planForm(plan: PlanDocument, { edit }: EditActions): (HTMLElement | null)[] {
  const set = (values: Partial<PlanDocument>): boolean => edit({ ...current, ...values });
  const setCeiling = (value: Value): boolean => set({ ceiling_height_m: value });
  return [
    h("h3", {}, "The whole plan"),
    text("plan-form-name", "Name", plan.name ?? "", (name) => set({ name })),
    number("plan-form-ceiling", "Ceiling, m", plan.ceiling_height_m, setCeiling, ASSUMED),
    ownCeilings(plan, edit),
    number("plan-form-camera", "Camera height, m", plan.camera_height_m, (value) =>
      set({ camera_height_m: value ?? undefined }),
    ),
    number("plan-form-north", "North, ° clockwise from up", plan.north_deg, (value) => set({ north_deg: value })),
    text("plan-form-anchor", `Place on Earth: ${PLACES}`, anchorText(plan.anchor ?? {}), (value) => {
      const anchor = anchorIn(value);
      if (anchor === null && value.trim() !== "") say(`“${value}” is no place on Earth. Give ${PLACES}.`);
      else set({ anchor });
    }),
    completeKinds(plan, edit),
    h("p", { class: "hint" }, `${plan.rooms.length} rooms. Click an element to change it.`),
  ];
}

/** Return the place of a plan on Earth as text. */
function anchorText({ latitude, longitude, control_points: points }: AnchorDocument): string {
  if (points) return points.map((point) => Object.values(point).join(", ")).join("; ");
  return latitude == null || longitude == null ? "" : `${latitude.toFixed(7)}, ${longitude.toFixed(7)}`;
}

/** Read the place on Earth of a plan's origin or of two of its points, besides its altitude; null if it is neither. */
function anchorIn(text: string): AnchorDocument | null {
  const numbers = text.trim().split(SEPARATORS).map(Number),
    altitude_m = current.anchor?.altitude_m;
  if (numbers.some(Number.isNaN)) return null;
  const pointAt = (first: number) => {
    const [x, y, latitude, longitude] = numbers.slice(first) as [number, number, number, number];
    return { x, y, latitude, longitude };
  };
  if (numbers.length === 2) return { latitude: numbers[0], longitude: numbers[1], altitude_m };
  return numbers.length === 8 ? { control_points: [pointAt(0), pointAt(4)], altitude_m } : null;
}

/** Name the rooms with ceilings of their own, to which the height of the plan does not apply. */
function ownCeilings({ rooms }: PlanDocument, edit: EditActions["edit"]): HTMLElement | null {
  const own = rooms.flatMap(({ name, ceiling_height_m: height }, index) =>
    height == null ? [] : [`${name || `room ${index + 1}`} ${height.toFixed(2)} m`],
  );
  if (own.length === 0) return null;
  const rest = own.length - MAX_NAMED;
  const named = own.slice(0, MAX_NAMED).join(", ") + (rest > 0 ? ` and ${rest} more` : "");
  return h(
    "p",
    { class: "hint", id: "plan-form-own-ceilings" },
    `${own.length} of ${rooms.length} rooms have ceilings of their own: ${named}. `,
    button("Give all rooms the plan’s ceiling", () => edit(change.withOneCeiling(current)), { id: "one-ceiling" }),
  );
}

/** Checkboxes for the kinds that are shown completely, whose absence then counts as well. */
function completeKinds(plan: PlanDocument, edit: EditActions["edit"]): HTMLElement {
  const claimed = change.claimedKinds(plan);
  return h(
    "fieldset",
    { class: "claims" },
    h("legend", {}, "Complete in this plan, and used by the search"),
    ...OPENING_KINDS.map((kind) => {
      const box = h("input", { type: "checkbox", id: `plan-form-all-${kind}`, checked: claimed.includes(kind) });
      box.addEventListener("change", () => edit(change.claimKind(current, kind, box.checked)));
      const trust = claimed.includes(kind) ? 1 : (plan.opening_trust?.[kind] ?? 0);
      box.indeterminate = trust > 0 && trust < 1;
      const share = box.indeterminate ? `, ${Math.round(100 * trust)} % of them drawn` : "";
      const count = (plan.openings ?? []).filter((opening) => opening.kind === kind).length;
      return h("label", { class: "inline" }, box, `${count} ${kind}${count === 1 ? "" : "s"}${share}`);
    }),
  );
}

function roomForm(room: RoomDocument, index: number, { edit, select }: EditActions): HTMLElement[] {
  const set = (values: Partial<RoomDocument>): boolean => edit(change.changeRoom(current, index, values));
  const hint = current.ceiling_height_m == null ? ASSUMED : `${current.ceiling_height_m} of the plan`;
  return [
    h("h3", {}, "Room"),
    text("room-form-name", "Name", room.name ?? "", (name) => {
      const { type, types } = current.rooms[index]!;
      set({ name, types: types?.length ? types : undefined });
      if ((type ?? "unknown") !== "unknown") say(`The type stays ${type}; “unknown” takes it from the name.`);
    }),
    choice("room-form-type", "Type", room.type ?? "unknown", ROOM_TYPES, (type) =>
      set({ type, types: type === "unknown" ? [] : undefined }),
    ),
    number("room-form-ceiling", "Ceiling, m", room.ceiling_height_m, (value) => set({ ceiling_height_m: value }), hint),
    button("Remove this room", () => {
      select({ kind: "none" });
      edit(change.removeRoom(current, index));
    }),
    wholePlan(select),
  ];
}

function openingForm(opening: OpeningDocument, index: number, { edit, select }: EditActions): HTMLElement[] {
  const set = (values: Partial<OpeningDocument>): boolean => edit(change.changeOpening(current, index, values));
  return [
    h("h3", {}, "Opening"),
    choice("opening-form-kind", "Kind", opening.kind, OPENING_KINDS, (kind) => set({ kind })),
    number("opening-form-width", "Width, m", change.widthOf(opening), (value) => {
      if (value != null && value > 0) edit(change.widenOpening(current, index, value));
    }),
    number("opening-form-sill", "From, m over the floor", opening.sill_m, (value) => set({ sill_m: value })),
    number("opening-form-head", "To, m over the floor", opening.head_m, (value) => set({ head_m: value })),
    button("Remove this opening", () => {
      select({ kind: "none" });
      edit(change.removeOpening(current, index));
    }),
    wholePlan(select),
  ];
}

/** Return the way back to the form of the plan. */
const wholePlan = (select: EditActions["select"]): HTMLElement =>
  button("The whole plan", () => select({ kind: "none" }), { id: "whole-plan" });

function field(id: string, label: string, input: HTMLElement): HTMLElement {
  input.id = id;
  return h("div", {}, h("label", { for: id }, label), input);
}

function text(id: string, label: string, value: string, set: (value: string) => void): HTMLElement {
  const input = h("input", { type: "text", maxlength: 200, value });
  input.addEventListener("change", () => set(input.value));
  return field(id, label, input);
}

function number(id: string, label: string, value: Value, set: (value: Value) => void, absent = "unknown"): HTMLElement {
  const shown = value == null ? null : Math.round(value * 1000) / 1000;
  const input = h("input", { type: "number", step: "any", placeholder: absent, value: shown });
  input.addEventListener("change", () => set(input.value.trim() === "" ? null : input.valueAsNumber));
  return field(id, label, input);
}

function choice<T extends string>(id: string, label: string, value: T, options: T[], set: (value: T) => void) {
  const input = h("select", {}, ...options.map((option) => h("option", { selected: option === value }, option)));
  input.addEventListener("change", () => set(input.value as T));
  return field(id, label, input);
}
