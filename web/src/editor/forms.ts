/** Forms for the properties of a room, an opening or the whole plan. */

import { button, h, show } from "../dom";
import { say } from "../notices";
import type { OpeningDocument, OpeningKind, PlanDocument, RoomDocument } from "../types";
import * as change from "./changes";
import type { EditActions, Selection } from "./handles";

type RoomType = NonNullable<RoomDocument["type"]>;

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
// Latitude and longitude, as maps give them.
const DEGREES = /^\s*(-?\d+(?:\.\d+)?)\s*[,;\s]\s*(-?\d+(?:\.\d+)?)\s*$/;
// Rooms that a hint names.
const MAX_NAMED = 6;
const OPENING_KINDS: OpeningKind[] = ["door", "window", "passage"];

export function showForm(place: HTMLElement, plan: PlanDocument, selection: Selection, actions: EditActions): void {
  if (place.contains(document.activeElement) && document.activeElement instanceof HTMLInputElement) {
    // The form already shows the typed text.
    if (place.dataset.of === JSON.stringify(selection)) return;
  }
  place.dataset.of = JSON.stringify(selection);
  const room = selection.kind === "room" ? plan.rooms[selection.index] : undefined;
  const opening = selection.kind === "opening" ? plan.openings?.[selection.index] : undefined;
  if (room !== undefined && selection.kind === "room") show(place, ...roomForm(room, selection.index, actions));
  else if (opening !== undefined && selection.kind === "opening")
    show(place, ...openingForm(opening, selection.index, actions));
  else show(place, ...planForm(plan, actions));
}

let current: PlanDocument = { rooms: [] };

/** Set the plan that forms change: the current one when a field is left, not when the form was created. */
export function setFormPlan(plan: PlanDocument): void {
  current = plan;
}

function planForm(plan: PlanDocument, { edit }: EditActions): (HTMLElement | null)[] {
  const set = (values: Partial<PlanDocument>): boolean => edit({ ...current, ...values });
  const { latitude, longitude } = plan.anchor ?? {};
  const place = latitude == null || longitude == null ? "" : `${latitude.toFixed(7)}, ${longitude.toFixed(7)}`;
  return [
    h("h3", {}, "The whole plan"),
    text("plan-form-name", "Name", plan.name ?? "", (name) => set({ name })),
    number(
      "plan-form-ceiling",
      "Ceiling, m",
      plan.ceiling_height_m,
      (value) => set({ ceiling_height_m: value }),
      ASSUMED,
    ),
    ownCeilings(plan, edit),
    number("plan-form-camera", "Camera height, m", plan.camera_height_m, (value) =>
      set({ camera_height_m: value ?? undefined }),
    ),
    number("plan-form-north", "North, ° clockwise from up", plan.north_deg, (value) => set({ north_deg: value })),
    text("plan-form-anchor", "Latitude, longitude of x 0, y 0", place, (value) => {
      const [latitudeDeg, longitudeDeg] = (DEGREES.exec(value) ?? []).slice(1).map(Number);
      const anchor = { ...current.anchor, latitude: latitudeDeg, longitude: longitudeDeg };
      if (latitudeDeg !== undefined) set({ anchor });
      else if (value.trim() === "") set({ anchor: null });
      else say(`“${value}” must be latitude and longitude in degrees, such as 48.13722, 11.57569.`);
    }),
    completeKinds(plan, edit),
    h(
      "p",
      { class: "hint" },
      `${plan.rooms.length} rooms, ${(plan.openings ?? []).length} openings. Click an element to change it.`,
    ),
  ];
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
  return [
    h("h3", {}, "Room"),
    text("room-form-name", "Name", room.name ?? "", (name) =>
      set({ name, types: room.types?.length ? room.types : undefined }),
    ),
    choice("room-form-type", "Type", room.type ?? "unknown", ROOM_TYPES, (type) =>
      set({ type, types: type === "unknown" ? [] : undefined }),
    ),
    number(
      "room-form-ceiling",
      "Ceiling, m",
      room.ceiling_height_m,
      (value) => set({ ceiling_height_m: value }),
      current.ceiling_height_m == null ? ASSUMED : `${current.ceiling_height_m} of the plan`,
    ),
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
      if (value !== null && value > 0) edit(change.widenOpening(current, index, value));
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

function number(
  id: string,
  label: string,
  value: number | null | undefined,
  set: (value: number | null) => void,
  absent = "unknown",
): HTMLElement {
  const input = h("input", {
    type: "number",
    step: "any",
    placeholder: absent,
    value: value == null ? null : String(Math.round(value * 1000) / 1000),
  });
  input.addEventListener("change", () => set(input.value.trim() === "" ? null : input.valueAsNumber));
  return field(id, label, input);
}

function choice<T extends string>(
  id: string,
  label: string,
  value: T,
  options: T[],
  set: (value: T) => void,
): HTMLElement {
  const input = h("select", {}, ...options.map((option) => h("option", { selected: option === value }, option)));
  input.addEventListener("change", () => set(input.value as T));
  return field(id, label, input);
}
