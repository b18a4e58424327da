/** Places on Earth (WGS84) as metres of a plan, as in lalaloc_core/floorplan/earth.py; within 10 km of the anchor to 0.2 m. */

import type { EarthPoint, PlanDocument, Point, Venue } from "./types";

/** Place of a plan's origin on Earth, and azimuth of true north in the plan. */
export type Anchor = EarthPoint & { north_deg: number };

// Semi-major axis (m) and squared eccentricity of the ellipsoid.
const AXIS_M = 6_378_137;
const ECCENTRICITY_2 = 0.00669437999;
const DEGREE = Math.PI / 180;

/** Return the anchor of a stored plan in a venue: its own, else the venue's; null without either. */
export function anchorOf({ anchor, north_deg }: PlanDocument, venue: Venue): Anchor | null {
  const { latitude, longitude } = anchor ?? {};
  return latitude == null || longitude == null ? venue.anchor : { latitude, longitude, north_deg: north_deg ?? 0 };
}

/** Convert a point of a plan to degrees. */
export function toEarth(anchor: Anchor, [x, y]: Point): EarthPoint {
  const { meridian, parallel, slope, cos, sin } = frameOf(anchor);
  const east = x * cos - y * sin;
  const north = x * sin + y * cos;
  const latitude = (north - (slope * east * east) / (2 * parallel)) / meridian;
  const longitude = (east * (1 + (slope * north) / parallel)) / (parallel * Math.cos(anchor.latitude * DEGREE));
  return { latitude: anchor.latitude + latitude / DEGREE, longitude: anchor.longitude + longitude / DEGREE };
}

/** Convert degrees to a point of a plan. */
export function toPlan(anchor: Anchor, { latitude, longitude }: EarthPoint): Point {
  const { meridian, parallel, slope, cos, sin } = frameOf(anchor);
  const up = (latitude - anchor.latitude) * DEGREE;
  const along = (longitude - anchor.longitude) * DEGREE * parallel * Math.cos(anchor.latitude * DEGREE);
  const east = along * (1 - (slope * meridian * up) / parallel);
  const north = meridian * up + (slope * east * east) / (2 * parallel);
  return [east * cos + north * sin, north * cos - east * sin];
}

/** Return the radii of curvature (m) at an anchor, along its meridian and across it, and the plan's rotation. */
function frameOf({ latitude, north_deg }: Anchor) {
  const sine = Math.sin(latitude * DEGREE);
  const parallel = AXIS_M / Math.sqrt(1 - ECCENTRICITY_2 * sine * sine);
  const meridian = (parallel * (1 - ECCENTRICITY_2)) / (1 - ECCENTRICITY_2 * sine * sine);
  const turn = north_deg * DEGREE;
  return { meridian, parallel, slope: Math.tan(latitude * DEGREE), cos: Math.cos(turn), sin: Math.sin(turn) };
}
