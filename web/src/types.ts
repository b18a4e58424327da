/** Types of the API, which the client generates from openapi.yaml, and of the page. Units are in the names. */

import type { Schemas } from "../../clients/typescript/src/index";

export type Point = [number, number];
export type RoomDocument = Schemas["RoomDocument"];
export type OpeningDocument = Schemas["OpeningDocument"];
export type OpeningKind = OpeningDocument["kind"];
export type PlanDocument = Schemas["FloorPlanDocument"];
export type PlanSummary = Schemas["FloorPlanSummary"];
export type PlanList = Schemas["FloorPlanList"];
export type PlanEvent = Schemas["PlanEvent"];
export type Venue = Schemas["VenueSummary"];
export type VenueList = Schemas["VenueList"];
export type VenuePlanDocument = Schemas["VenuePlanDocument"];
export type VenuePlanList = Schemas["VenuePlanList"];
export type RoomLayout = Schemas["RoomLayoutAnswer"];
export type Layout = Schemas["LayoutAnswer"];
export type Localisability = Schemas["LocalisabilityAnswer"];
export type Candidate = Schemas["CandidateAnswer"];
export type Posterior = Schemas["PosteriorAnswer"];
export type SequenceAnswer = Schemas["SequenceAnswer"];
/** Answer to a photograph; `together` states that it was asked for with others. */
export type Answer = Schemas["LocaliseAnswer"] & { together?: Together };
export type Session = Schemas["SessionAnswer"];
export type SessionDocument = Schemas["SessionDocument"];
export type ViewAnswer = Schemas["ViewAnswer"];
export type Problem = Schemas["Problem"];
export type Fault = Schemas["Fault"];

export type { Plan } from "../../clients/typescript/src/index";

export interface Pose {
  x_m: number;
  y_m: number;
  heading_deg: number;
}

/** Photographs that were localised together, and the probability that all of their places are right. */
export interface Together {
  motion: "turn" | "walk";
  photographs: number;
  confidence: number | null;
}

/** Hints of the place of a photograph: a circle on the plan, and rooms. */
export interface Hints {
  near: Point | null;
  radius: number;
  rooms: string[];
  strict: boolean;
}
