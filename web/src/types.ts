/** What the API takes and answers, as far as the pages use it. Units stand in the names. */

export type Point = [number, number];

export interface RoomDocument {
  id?: string | null;
  name?: string;
  type?: string;
  polygon: Point[];
  holes?: Point[][];
  walls?: [Point, Point][];
  ceiling_height_m?: number | null;
}

export type OpeningKind = "door" | "window" | "passage";

export interface OpeningDocument {
  kind: OpeningKind;
  line: [Point, Point];
  sill_m?: number | null;
  head_m?: number | null;
  name?: string | null;
  rooms?: string[] | null;
}

export interface PlanDocument {
  name?: string;
  ceiling_height_m?: number | null;
  camera_height_m?: number | null;
  camera_height_std_m?: number | null;
  north_deg?: number | null;
  rooms: RoomDocument[];
  openings?: OpeningDocument[];
  opening_kinds?: OpeningKind[] | null;
  opening_tolerance_m?: number;
}

export type PlanStatus = "preparing" | "ready" | "failed" | "superseded";

export interface Plan {
  id: string;
  revision: string;
  revision_number: number;
  name: string;
  status: PlanStatus;
  progress: number;
  reason: string | null;
  rooms: { id: string; name: string; type: string; area_m2: number; ceiling_height_m: number; vertices: number }[];
  area_m2: number;
  warnings: string[];
  /** How its file was read. */
  import_report?: { format: string; metres_per_unit: number | null; is_draft: boolean; notes: string[]; unsure: string[] } | null;
  plan: PlanDocument;
  /** Entity tag of this representation, which `If-Match` takes. */
  etag: string;
}

export interface PlanSummary {
  id: string;
  revision: string;
  name: string;
  status: PlanStatus;
  progress: number;
  rooms: number;
  area_m2: number;
  created_at: string;
  updated_at: string;
}

export interface Venue {
  id: string;
  name: string;
  plans: number;
}

/** A plan of a venue. */
export interface VenuePlan {
  floorplan_id: string;
  level: number;
  name: string;
  status: PlanStatus;
}

export interface OpeningPiece {
  kind: OpeningKind;
  wall: number;
  start: number;
  end: number;
  sill_m: number | null;
  head_m: number | null;
}

/** One room as the renderer sees it: walls with pieces of them that are openings. */
export interface RoomLayout {
  id: string;
  name: string;
  polygon: Point[];
  holes: Point[][];
  ceiling_height_m: number;
  walls_m: [number, number, number, number][];
  openings: OpeningPiece[];
}

export interface Layout {
  floorplan_id: string;
  revision: string;
  rooms: RoomLayout[];
}

export interface Pose {
  x_m: number;
  y_m: number;
  heading_deg: number;
}

/** What is known of where a camera stood: a place on the plan with how far off it may be, rooms. */
export interface Hints {
  near: Point | null;
  radius: number;
  rooms: string[];
  strict: boolean;
}

export interface Candidate {
  floorplan_id: string;
  level: number | null;
  position: { x_m: number; y_m: number };
  heading_deg: number;
  room: string;
  room_id: string;
  probability: number | null;
  cost: number;
}

export interface Posterior {
  step_m: number;
  x_m: number[];
  y_m: number[];
  probability: number[];
}

export interface Answer {
  floorplan_id: string;
  floorplan_revision: string;
  venue_id?: string | null;
  level: number | null;
  /** Of a venue: its most probable plans. */
  plans?: { floorplan_id: string; level: number; name: string; probability: number | null }[] | null;
  answer_id?: string | null;
  position: { x_m: number; y_m: number };
  heading_deg: number;
  room: string;
  room_id: string;
  confidence: number | null;
  heading_confidence: number | null;
  warnings: string[];
  heading_source: "given" | "panorama" | "searched";
  stage: "retrieval" | "vdr" | "lpo";
  covariance_m2: [Point, Point] | null;
  heading_std_deg: number | null;
  camera_height_m: number;
  candidates: Candidate[];
  posterior: Posterior | null;
  geopose?: { position: { lat: number; lon: number; h: number } } | null;
  timings_ms: Record<string, number>;
  model: { name: string; version: string; sha256: string };
}

export interface Fault {
  field: string;
  message: string;
}
