/** Projection of directions to photographs that are no full spheres, as in lalaloc_core/photograph/cameras.py. */

import { radians } from "./layout";
import type { Size } from "./projection";
import type { Point, ViewAnswer } from "./types";

/** Direction: right, forward, up. */
export type Ray = [number, number, number];
type Place = (ray: Ray) => Point | null;
/** Parts of the view that place rays in the photograph. */
export type CameraView = Pick<ViewAnswer, "projection" | "camera" | "hfov" | "pitch" | "roll">;

const LARGEST_STEP = radians(1);
// Perspective cameras are drawn up to this angle from the optical axis.
const WIDEST = Math.tan(radians(80));
// A picture whose ratio of sides differs by more than this share from the camera's has bars.
const BARS = 0.02;

export const dot = (a: Ray, b: Ray): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Return the direction of an azimuth and an elevation. */
export const rayOf = (azimuth: number, elevation: number): Ray => [
  Math.cos(elevation) * Math.sin(azimuth),
  Math.cos(elevation) * Math.cos(azimuth),
  Math.sin(elevation),
];

/**
 * Project a line of (azimuth from the photograph's centre, elevation) to a photograph that fills `size`; parts that it
 * does not show are cut off.
 */
export function throughCamera(line: Point[], view: CameraView, size: Size): Point[][] {
  const place = placeOf(view, size),
    tilt = tiltOf(view),
    pieces: Point[][] = [[]];
  for (const [azimuth, elevation] of dense(line)) {
    const point = place(tilt(rayOf(azimuth, elevation)));
    if (point !== null && inside(point, size)) pieces.at(-1)!.push(point);
    else if (pieces.at(-1)!.length > 0) pieces.push([]);
  }
  return pieces.filter((piece) => piece.length > 1);
}

/** Return whether a picture of a size shows a place. */
export function inside([x, y]: Point, { width, height }: Size): boolean {
  return x >= 0 && x <= width && y >= 0 && y <= height;
}

/** Add points, so that straight lines can be bent and cut. */
function dense(line: Point[]): Point[] {
  return line.flatMap((point, index) => {
    const next = line[index + 1];
    if (next === undefined) return [point];
    const [dx, dy] = [next[0] - point[0], next[1] - point[1]];
    const steps = Math.max(1, Math.ceil(Math.max(Math.abs(dx), Math.abs(dy)) / LARGEST_STEP));
    return Array.from({ length: steps }, (_, step): Point => [
      point[0] + (step / steps) * dx,
      point[1] + (step / steps) * dy,
    ]);
  });
}

/** Return the rotation of level rays (right, forward, up) into the camera's frame. */
export function tiltOf(view: Pick<CameraView, "projection" | "pitch" | "roll">): (ray: Ray) => Ray {
  // The pitch of a strip is in its projection.
  const pitch = view.projection === "cylindrical" ? 0 : radians(view.pitch.value_deg),
    roll = radians(view.roll.value_deg);
  const [sp, cp, sr, cr] = [Math.sin(pitch), Math.cos(pitch), Math.sin(roll), Math.cos(roll)];
  return ([right, forward, up]) => {
    const ahead = forward * cp + up * sp,
      above = up * cp - forward * sp;
    return [cr * right - sr * above, ahead, sr * right + cr * above];
  };
}

/** Return the projection of rays in the camera’s frame to a photograph that fills `size`; null for those that it cannot show. */
export function placeOf(view: CameraView, size: Size): Place {
  const { camera } = view;
  if (camera === null) return around(view, size);
  const { width, height } = camera;
  let [across, down] = [size.width / width, size.height / height];
  // Bars around a photograph, which the service cuts off, are taken for equal.
  if (Math.abs(Math.log(across / down)) > BARS) across = down = Math.min(across, down);
  const bend = view.projection === "fisheye" ? fisheye(camera.distortion) : pinhole(camera.distortion);
  return (ray) => {
    const point = bend(ray);
    if (point === null) return null;
    // OpenCV counts from the centre of the first pixel.
    const [x, y] = [camera.fx * point[0] + camera.cx + 0.5, camera.fy * point[1] + camera.cy + 0.5];
    if (!inside([x, y], camera)) return null;
    return [0.5 * size.width + (x - 0.5 * width) * across, 0.5 * size.height + (y - 0.5 * height) * down];
  };
}

function pinhole([k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0]: number[]): Place {
  return ([right, forward, up]) => {
    const x = right / forward,
      y = -up / forward,
      square = x * x + y * y;
    if (forward <= 0 || square > WIDEST ** 2) return null;
    // Beyond the turning point of the distortion, rays would be folded back into the picture.
    if (1 + square * (3 * k1 + square * (5 * k2 + square * 7 * k3)) <= 0) return null;
    const gain = 1 + square * (k1 + square * (k2 + square * k3));
    return [
      x * gain + 2 * p1 * x * y + p2 * (square + 2 * x * x),
      y * gain + 2 * p2 * x * y + p1 * (square + 2 * y * y),
    ];
  };
}

function fisheye([k1 = 0, k2 = 0, k3 = 0, k4 = 0]: number[]): Place {
  return ([right, forward, up]) => {
    const across = Math.hypot(right, up),
      angle = Math.atan2(across, forward),
      square = angle * angle;
    const radius = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))));
    const gain = radius / Math.max(across, 1e-12);
    return [right * gain, -up * gain];
  };
}

/** Strip around the camera, or a part of the sphere, with square pixels at the horizon. */
function around(view: CameraView, size: Size): Place {
  const perRadian = size.width / radians(view.hfov.value_deg),
    middle = radians(view.pitch.value_deg);
  const isStrip = view.projection === "cylindrical";
  const horizon = 0.5 * size.height + (isStrip ? Math.tan(middle) : 0) * perRadian;
  return ([right, forward, up]) => {
    const across = Math.hypot(right, forward),
      rise = isStrip ? up / Math.max(across, 1e-12) : Math.atan2(up, across);
    return [0.5 * size.width + Math.atan2(right, forward) * perRadian, horizon - rise * perRadian];
  };
}
