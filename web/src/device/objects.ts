/** Objects in photographs that are no spheres, as in lalaloc_core/localise/encode/view_encoder.py. */

import { type CameraView, dot, type Ray, tiltOf } from "../camera";
import { radians } from "../layout";
import type { Size } from "../projection";

// As in lalaloc_core/photograph/photograph.py.
const PIXELS = 320 * 256,
  STEP = 32,
  MAX_ASPECT = 8;

/** Return the size of the whole picture in which objects are recognised. */
export function thumbnailSize({ width, height }: Size): Size {
  const aspect = Math.min(Math.max(width / height, 1 / MAX_ASPECT), MAX_ASPECT),
    rows = Math.max(1, Math.round(Math.sqrt(PIXELS / aspect) / STEP));
  return { width: Math.max(1, Math.round(aspect * rows)) * STEP, height: rows * STEP };
}

/** Return the azimuth (radians) of the middle of each column of a photograph, relative to its centre. */
export function columnAzimuths(view: CameraView, columns: number): number[] {
  const { camera } = view,
    tilt = tiltOf(view),
    // Images of the level axes right and forward; their products with a ray undo the tilt.
    right = tilt([1, 0, 0]),
    forward = tilt([0, 1, 0]);
  return Array.from({ length: columns }, (_, column) => {
    const share = (column + 0.5) / columns - 0.5;
    const ray: Ray =
      camera === null
        ? [Math.sin(share * radians(view.hfov.value_deg)), Math.cos(share * radians(view.hfov.value_deg)), 0]
        : [(share * camera.width) / camera.fx, 1, 0];
    return Math.atan2(dot(ray, right), dot(ray, forward));
  });
}
