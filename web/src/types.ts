/** Types of the API, which the client generates from openapi.yaml, and of the page. Units are in the names. */

import type { Schemas } from "../../clients/typescript/src/index";

export type Point = [number, number];
export type RoomDocument = Schemas["RoomDocument"];
export type OpeningDocument = Schemas["OpeningDocument"];
export type OpeningKind = OpeningDocument["kind"];
export type PlanDocument = Schemas["FloorPlanDocument"];
export type AnchorDocument = Schemas["AnchorDocument"];
export type PlanSummary = Schemas["FloorPlanSummary"];
export type PlanEvent = Schemas["PlanEvent"];
export type Venue = Schemas["VenueSummary"];
/** The venue that is searched, with the first of its plans. */
export type ChosenVenue = Venue & { listed: VenuePlanList["plans"] };
export type VenuePlanList = Schemas["VenuePlanList"];
export type RoomLayout = Schemas["RoomLayoutAnswer"];
export type Layout = Schemas["LayoutAnswer"];
export type Localisability = Schemas["LocalisabilityAnswer"];
export type Candidate = Schemas["CandidateAnswer"];
export type Posterior = Schemas["PosteriorAnswer"];
export type SequenceAnswer = Schemas["SequenceAnswer"];
/**
 * Answer to a photograph; `together` states that it was asked for with others. The revision is unknown if the photograph
 * lies in another plan than the first of them.
 */
export type Answer = Omit<Schemas["LocaliseAnswer"], "floorplan_revision"> & {
  floorplan_revision?: string;
  /** Photographs of a turn that were localised together, and the probability that all of their places are right. */
  together?: { photographs: number; confidence: number | null };
};
export type Session = Schemas["SessionAnswer"];
export type ViewAnswer = Schemas["ViewAnswer"];

export type { Plan } from "../../clients/typescript/src/index";

export interface Pose {
  x_m: number;
  y_m: number;
  heading_deg: number;
}

export type EarthPoint = Schemas["EarthPoint"];

/** Hints of the place of a photograph: a circle on the plan, rooms and, in a venue, a level. */
export interface Hints {
  /** Centre of the circle: metres of the plan, or degrees, which all plans of a venue share. */
  near: Schemas["PlanPoint"] | EarthPoint | null;
  radius: number;
  rooms: string[];
  level: number | null;
  strict: boolean;
}
