/** Projection and field of view of a photograph, as in lalaloc_core/photograph/projection.py and exif.py; angles are radians. */

import { InputError } from "../input_error";
import { radians } from "../layout";
import type { Size } from "../projection";
import type { ViewAnswer } from "../types";
import { type Metadata, TAG } from "./metadata";

type Source = ViewAnswer["projection_source"];

/** Statements about the camera, by the names of the API's fields. */
export type Stated = Readonly<Partial<Record<"projection" | "hfov_deg" | "pitch_deg" | "roll_deg", string>>>;

export interface Lens {
  projection: "equirectangular" | "perspective" | "cylindrical";
  projectionSource: Source;
  /** Null if it is to be estimated. */
  hfov: number | null;
  hfovSource: Source;
  /** Relative standard deviation of the focal length. */
  focalSd: number;
  warnings: string[];
}

const GIVEN_SD = 0.01,
  EXIF_SD = 0.03,
  CROPPED_SD = 0.06;
const SPHERE_TOLERANCE = 0.02,
  LONGEST = 2.25,
  WIDEST_LENS_DEG = 120;
const HFOV_DEG = { equirectangular: [10, 360], perspective: [10, 150], cylindrical: [10, 360] } as const;
// 35 mm film, as in exif.py.
const DIAGONAL_MM = Math.hypot(36, 24),
  LONG_MM = 0.8 * DIAGONAL_MM,
  SHORT_MM = 0.6 * DIAGONAL_MM;
const FILM_MM = [4, 250] as const,
  ZOOM = [1, 20] as const,
  STRIP = 6,
  CROPPED = 0.03;
const CROP = [
  "CroppedAreaImageWidthPixels",
  "CroppedAreaImageHeightPixels",
  "FullPanoWidthPixels",
  "FullPanoHeightPixels",
] as const;
const OTHERWISE = "or encode it with the command line (lalaloc encode)";

/** Return the lens of an upright picture: as stated, by its metadata, or by its pixels. */
export function findLens(size: Size, stated: Stated, metadata: Metadata, isSphere: () => boolean): Lens {
  const exif = readLens(metadata, size),
    twiceAsWide = Math.abs(size.width / size.height - 2) <= SPHERE_TOLERANCE;
  const hfovDeg = stated.hfov_deg === undefined ? null : Number(stated.hfov_deg);
  const [projection, projectionSource] = projectionOf(size, stated, hfovDeg, metadata, exif, twiceAsWide && isSphere);
  const lens = (hfov: number | null, hfovSource: Source, focalSd: number, warnings: string[] = []): Lens => ({
    projection,
    projectionSource,
    hfov,
    hfovSource,
    focalSd,
    warnings,
  });
  if (projection === "equirectangular") {
    if ((hfovDeg !== null && hfovDeg !== 360) || isPart(metadata)) {
      throw new InputError(
        `The browser computes features of full 360° photographs only, not of parts. Use the whole photograph, ${OTHERWISE}.`,
      );
    }
    if (!twiceAsWide)
      throw new InputError(
        `The photograph is ${size.width} × ${size.height}; a full 360° photograph is twice as wide as high.`,
      );
    return lens(2 * Math.PI, projectionSource, 0);
  }
  if (hfovDeg !== null) {
    const [low, high] = HFOV_DEG[projection];
    if (!(hfovDeg >= low && hfovDeg <= high))
      throw new InputError(`“Field of view” is ${hfovDeg}°; it must be between ${low}° and ${high}°.`);
    return lens(radians(hfovDeg), "given", GIVEN_SD);
  }
  if (projection === "cylindrical") {
    const angle = cylinder(metadata);
    if (angle === null)
      throw new InputError("Nothing states the angle that the strip shows. Enter its “Field of view” (up to 360°).");
    return lens(angle, "gpano", GIVEN_SD);
  }
  const hfov = exif.focal === null ? null : 2 * Math.atan((0.5 * size.width) / exif.focal);
  if (hfov === null || hfov < radians(HFOV_DEG.perspective[0]) || hfov > radians(HFOV_DEG.perspective[1]))
    return lens(null, "estimated", 0);
  return lens(hfov, "exif", exif.sd, exif.warnings);
}

function projectionOf(
  { width, height }: Size,
  stated: Stated,
  hfovDeg: number | null,
  { sphere }: Metadata,
  exif: ExifLens,
  isSphere: false | (() => boolean),
): [Lens["projection"], Source] {
  const kind = sphere.get("ProjectionType")?.toLowerCase();
  if (stated.projection === "fisheye")
    throw new InputError(
      `The browser computes no features of fisheye photographs. Export an ordinary one, ${OTHERWISE}.`,
    );
  if (stated.projection !== undefined) return [stated.projection as Lens["projection"], "given"];
  if (kind === "equirectangular" || (kind === undefined && CROP.some((name) => sphere.has(name))))
    return ["equirectangular", "gpano"];
  if (kind === "cylindrical") return ["cylindrical", "gpano"];
  if (isSphere && (hfovDeg ?? 360) === 360 && isSphere()) return ["equirectangular", "estimated"];
  if (hfovDeg !== null) return [exif.strip || hfovDeg > WIDEST_LENS_DEG ? "cylindrical" : "perspective", "assumed"];
  if (exif.strip) return ["cylindrical", "exif"];
  if (exif.focal === null && isSphere) {
    throw new InputError(
      "The photograph is twice as wide as high, but it does not look like a full 360° photograph. Enter its “Kind” and “Field of view”.",
    );
  }
  if (Math.max(width, height) > LONGEST * Math.min(width, height)) {
    throw new InputError(
      "The photograph is a strip. Choose the “Kind” panorama mode of a phone, and enter its “Field of view” (up to 360°).",
    );
  }
  return ["perspective", exif.focal === null ? "assumed" : "exif"];
}

/** Return whether the metadata place the picture on a part of the sphere. */
function isPart({ sphere }: Metadata): boolean {
  const [width, height, fullWidth, fullHeight] = CROP.map((name) => Number(sphere.get(name)));
  return CROP.every((name) => sphere.has(name)) && (width! < fullWidth! || height! < fullHeight!);
}

function cylinder({ sphere }: Metadata): number | null {
  const [part, full] = [Number(sphere.get("CroppedAreaImageWidthPixels")), Number(sphere.get("FullPanoWidthPixels"))];
  return part > 0 && part <= full ? (2 * Math.PI * part) / full : null;
}

interface ExifLens {
  /** Focal length, pixels of the full picture. */
  focal: number | null;
  sd: number;
  strip: boolean;
  warnings: string[];
}

/** Read the 35 mm equivalent focal length. */
function readLens({ exif }: Metadata, { width, height }: Size): ExifLens {
  const none: ExifLens = { focal: null, sd: 0, strip: exif.get(TAG.customRendered) === STRIP, warnings: [] };
  const film = exif.get(TAG.film) ?? 0,
    zoom = exif.get(TAG.zoom) ?? 0;
  if (none.strip || !(film >= FILM_MM[0] && film <= FILM_MM[1])) return none;
  const long = Math.max(width, height),
    ratio = long / Math.min(width, height);
  const [across, down] = [exif.get(TAG.width) ?? 0, exif.get(TAG.height) ?? 0];
  // Cropped after it was taken.
  if (across >= 1 && down >= 1 && Math.abs(Math.max(across, down) / Math.min(across, down) / ratio - 1) > CROPPED)
    return none;
  const isUsual = Math.min(Math.abs(ratio - 4 / 3), Math.abs(ratio - 1.5)) < 0.05;
  const side = Math.abs(ratio - 1.5) < 0.05 ? 36 : ratio >= 4 / 3 ? LONG_MM : SHORT_MM * ratio;
  // Makers disagree whether the equivalent focal length includes digital zoom.
  const doubt = zoom >= ZOOM[0] && zoom <= ZOOM[1] ? 0.5 * Math.log(zoom) : 0;
  return { ...none, focal: (film / side) * long, sd: Math.max(isUsual ? EXIF_SD : CROPPED_SD, doubt) };
}

/** Return an angle of the Photo Sphere metadata, degrees; null if it is missing or out of range. */
export function poseAngle({ sphere }: Metadata, name: string, low: number, high: number): number | null {
  const value = Number(sphere.get(name) || NaN);
  return value >= low && value <= high ? value : null;
}
