/** Level patches of photographs that are no full spheres, as in lalaloc_core/photograph/patches.py; angles are radians. */

import { type CameraView, inside, placeOf, rayOf, tiltOf } from "../camera";
import { degrees, radians } from "../layout";
import { nearest, type Pixels, sample } from "./pixels";

export interface PatchSize {
  width: number;
  height: number;
  hfov: number;
  /** Elevation of the upper border. */
  top: number;
  /** Azimuths of patches are multiples of this. */
  step: number;
}

const UNSEEN = 127,
  SLACK = 1.03,
  OVERLAP = 0.2;
/** Resolution of the photograph that patches are sampled from, relative to theirs. */
export const FINER = 1.4;
// Seen azimuths: samples of the left and right border, and the largest elevation that counts.
const SAMPLES = 33,
  MAX_ELEVATION = radians(45);

/** Return the azimuths of the patches that cover a field of view, in steps from its centre. */
export function patchSteps(hfov: number, { hfov: width, step }: PatchSize): number[] {
  if (hfov <= SLACK * width) return [0];
  const apart = (1 - OVERLAP) * width,
    isFull = hfov > 2 * Math.PI - 0.5 * width;
  const count = isFull ? Math.ceil((2 * Math.PI) / apart) : 1 + Math.ceil((hfov - width) / apart);
  const azimuth = (index: number): number =>
    isFull ? ((index + 0.5) / count - 0.5) * 2 * Math.PI : (index / (count - 1) - 0.5) * (hfov - width);
  return Array.from({ length: count }, (_, index) => Math.round(azimuth(index) / step));
}

/** Cut a patch: RGB, and opacity where the photograph shows it. */
export function cutPatch(picture: Pixels, view: CameraView, azimuth: number, size: PatchSize): Uint8Array {
  const patch = new Uint8Array(4 * size.width * size.height);
  const place = placeOf(view, picture),
    tilt = tiltOf(view),
    perPixel = size.hfov / size.width;
  for (let row = 0, to = 0; row < size.height; row++) {
    const elevation = size.top - (row + 0.5) * perPixel;
    for (let column = 0; column < size.width; column++, to += 4) {
      const turned = azimuth + (column + 0.5) * perPixel - 0.5 * size.hfov;
      const point = place(tilt(rayOf(turned, elevation)));
      if (point === null || !inside(point, picture)) patch.fill(UNSEEN, to, to + 3);
      else {
        sample(picture, point[0], point[1], nearest, patch, to);
        patch[to + 3] = 255;
      }
    }
  }
  return patch;
}

/** Return the azimuths (degrees) of the leftmost and rightmost ray that a patch can show. */
export function seenDeg(view: CameraView): [number, number] {
  const half = 0.5 * view.hfov.value_deg,
    { camera } = view;
  if (camera === null || half > 90) return [-half, half];
  const [pitch, roll] = [radians(view.pitch.value_deg), radians(view.roll.value_deg)];
  const azimuths: number[] = [];
  for (const right of [(-0.5 * camera.width) / camera.fx, (0.5 * camera.width) / camera.fx]) {
    for (let index = 0; index < SAMPLES; index++) {
      const above = ((0.5 - index / (SAMPLES - 1)) * camera.height) / camera.fy;
      // From the camera's frame to the level one.
      const across = Math.cos(roll) * right + Math.sin(roll) * above,
        up = Math.cos(roll) * above - Math.sin(roll) * right;
      const forward = Math.cos(pitch) - Math.sin(pitch) * up,
        rise = Math.sin(pitch) + Math.cos(pitch) * up;
      if (Math.abs(Math.atan2(rise, Math.hypot(across, forward))) < MAX_ELEVATION)
        azimuths.push(Math.atan2(across, forward));
    }
  }
  return azimuths.length === 0 ? [-half, half] : [degrees(Math.min(...azimuths)), degrees(Math.max(...azimuths))];
}
