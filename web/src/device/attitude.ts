/** Tilt of a camera from straight lines, as in lalaloc_core/photograph/levelling.py, which explains the method; angles are radians. */

import { dot, type Ray, tiltOf } from "../camera";
import { degrees, radians } from "../layout";
import type { Size } from "../projection";
import type { Segment } from "./segments";

export interface Attitude {
  pitch: number;
  roll: number;
  pitchSd: number;
  rollSd: number;
  /** Azimuth of one of the two horizontal directions relative to the optical axis; repeats by a quarter turn. */
  yaw: number;
  /** Its standard deviation; infinite without lines. */
  yawSd: number;
}

const SIGMA = radians(0.6),
  SIGMA_PIXELS = 0.6,
  COARSE_SIGMA = radians(2);
const SHARES = [0.3, 0.2, 0.2] as const,
  OUTLIERS = 0.3 / Math.PI;
const PRIOR = [radians(12), radians(4), Infinity] as const,
  FLOOR = [radians(0.5), radians(0.4), radians(0.4)] as const,
  QUARTER = Math.PI / 2;
/** Tilts with a larger standard deviation are assumed rather than estimated. */
export const MAX_ESTIMATED_SD = radians(4);
const STARTS = 16,
  REFINED = 3,
  APART = radians(3),
  STEPS = 10,
  DELTA = 1e-5,
  TEMPERATURE = 0.15;

type Angles = [number, number, number];

interface Line {
  normal: Ray;
  middle: Ray;
  weight: number;
  /** Angular error of its ends. */
  blur: number;
}

interface Mode {
  angles: Angles;
  score: number;
  /** Variances of the angles. */
  variance: Angles;
}

const NO_LINES: Mode = { angles: [0, 0, 0], score: 0, variance: [PRIOR[0] ** 2, PRIOR[1] ** 2, Infinity] };
// Fields of view of the longer side, if unknown: values to try, and the prior of log focal length of phones.
const LONG_FOVS = [44, 48, 52, 57, 62, 67, 73, 79, 86, 93, 100, 108, 116].map(radians),
  USUAL_FOV = radians(72),
  FOV_SD = 0.35,
  FOCAL_FLOOR = 0.03;

const range = (first: number, last: number, step: number): number[] =>
  Array.from({ length: Math.round((last - first) / step) + 1 }, (_, index) => radians(first + index * step));
const PITCHES = range(-40, 40, 2.5),
  ROLLS = range(-17.5, 17.5, 2.5),
  YAWS = range(0, 87, 3);

/** Return the most probable tilt of a perspective camera that sees segments; with few, the prior of handheld cameras. */
export function estimateAttitude(segments: Segment[], { width, height }: Size, hfov: number): Attitude {
  const lines = linesOf(segments, width, height, (0.5 * width) / Math.tan(0.5 * hfov));
  return attitudeOf(lines.length === 0 ? [NO_LINES] : starts(lines).map((start) => refined(lines, start)));
}

export interface Calibration {
  hfov: number;
  /** Relative standard deviation of the focal length. */
  focalSd: number;
  attitude: Attitude;
}

/** Return the most probable field of view and tilt of a perspective camera about which nothing is known. */
export function estimateCalibration(segments: Segment[], { width, height }: Size): Calibration {
  const focalOf = (fov: number): number => (0.5 * Math.max(width, height)) / Math.tan(0.5 * fov);
  const usual = Math.log(focalOf(USUAL_FOV)),
    logs = LONG_FOVS.map((fov) => Math.log(focalOf(fov)));
  const modes = logs.map((log): Mode => {
    const lines = linesOf(segments, width, height, Math.exp(log)),
      mode = lines.length === 0 ? NO_LINES : refined(lines, starts(lines)[0]!);
    return { ...mode, score: mode.score - 0.5 * ((log - usual) / FOV_SD) ** 2 };
  });
  const best = Math.max(...modes.map(({ score }) => score)),
    weights = modes.map(({ score }) => Math.exp(score - best));
  const sum = weights.reduce((a, b) => a + b),
    meanOf = (values: number[]): number =>
      values.reduce((all, value, index) => all + (weights[index]! * value) / sum, 0);
  const mean = meanOf(logs),
    variance = meanOf(logs.map((log) => (log - mean) ** 2));
  return {
    hfov: 2 * Math.atan((0.5 * width) / Math.exp(mean)),
    focalSd: Math.sqrt(variance + FOCAL_FLOOR ** 2),
    attitude: attitudeOf(modes),
  };
}

/** Return the best of several modes, with the spread of all. */
function attitudeOf(modes: Mode[]): Attitude {
  const best = modes.reduce((a, b) => (b.score > a.score ? b : a));
  const weights = modes.map(({ score }) => Math.exp(score - best.score)),
    sum = weights.reduce((a, b) => a + b),
    fold = (angle: number): number => angle - QUARTER * Math.round(angle / QUARTER);
  const [pitchSd, rollSd, yawSd] = ([0, 1, 2] as const).map((axis) => {
    const spread = modes.reduce((total, mode, index) => {
      const apart = mode.angles[axis] - best.angles[axis];
      return total + (weights[index]! * (axis === 2 ? fold(apart) : apart) ** 2) / sum;
    }, 0);
    return Math.min(Math.sqrt(best.variance[axis] + FLOOR[axis] ** 2 + spread), PRIOR[axis]);
  }) as Angles;
  const [pitch, roll, yaw] = best.angles;
  return { pitch, roll, yaw, pitchSd, rollSd, yawSd };
}

/** Return the segments as planes through the camera. */
function linesOf(segments: Segment[], width: number, height: number, focal: number): Line[] {
  const found: { normal: Ray; middle: Ray; length: number }[] = [];
  for (const [x1, y1, x2, y2] of segments) {
    const [a, b] = [
      unit([(x1 - 0.5 * width) / focal, 1, (0.5 * height - y1) / focal]),
      unit([(x2 - 0.5 * width) / focal, 1, (0.5 * height - y2) / focal]),
    ];
    const cross: Ray = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const sine = Math.hypot(...cross);
    if (sine > 1e-4)
      found.push({
        normal: unit(cross),
        middle: unit([a[0] + b[0], a[1] + b[1], a[2] + b[2]]),
        length: Math.atan2(sine, dot(a, b)),
      });
  }
  const sorted = found.map(({ length }) => length).sort((a, b) => a - b),
    half = sorted.length >> 1;
  const median = sorted.length % 2 === 1 ? sorted[half]! : 0.5 * ((sorted[half - 1] ?? 1) + (sorted[half] ?? 1));
  return found.map(({ normal, middle, length }) => ({
    normal,
    middle,
    weight: TEMPERATURE * Math.sqrt(length / median),
    blur: SIGMA_PIXELS / focal / length,
  }));
}

function unit(ray: Ray): Ray {
  const length = Math.hypot(...ray);
  return [ray[0] / length, ray[1] / length, ray[2] / length];
}

/** Return the rotation of level rays into the frame of a camera. */
function rotation(pitch: number, roll: number): (ray: Ray) => Ray {
  const angle = (value: number) => ({ value_deg: degrees(value), std_deg: 0, source: "assumed" as const });
  return tiltOf({ projection: "perspective", pitch: angle(pitch), roll: angle(roll) });
}

/** Return the vertical and the two horizontal directions in the camera's frame. */
function directions([pitch, roll, yaw]: Angles): [Ray, Ray, Ray] {
  const tilt = rotation(pitch, roll);
  return [tilt([0, 0, 1]), tilt([Math.sin(yaw), Math.cos(yaw), 0]), tilt([Math.cos(yaw), -Math.sin(yaw), 0])];
}

/** Return the sine of the angle between the middle of a segment and a direction. */
const distance = ({ middle }: Line, direction: Ray): number =>
  Math.sqrt(Math.max(1 - dot(middle, direction) ** 2, 1e-3));
const density = (error: number, sigma: number): number =>
  Math.exp(-0.5 * (error / sigma) ** 2) / (sigma * Math.sqrt(2 * Math.PI));
const likelihood = (line: Line, direction: Ray, least: number): number =>
  density(dot(line.normal, direction) / distance(line, direction), Math.hypot(least, line.blur));

/** Return the best attitudes of a coarse search. */
function starts(lines: Line[]): Angles[] {
  const coarse = PITCHES.flatMap((pitch) =>
    ROLLS.map((roll) => {
      const upright = rotation(pitch, roll)([0, 0, 1]),
        prior = -0.5 * ((pitch / PRIOR[0]) ** 2 + (roll / PRIOR[1]) ** 2);
      const score = lines.reduce(
        (sum, line) =>
          sum + line.weight * Math.log(SHARES[0] * likelihood(line, upright, COARSE_SIGMA) + OUTLIERS + 0.4 / Math.PI),
        prior,
      );
      return { pitch, roll, prior, score };
    }),
  );
  const found = coarse
    .sort((a, b) => b.score - a.score)
    .slice(0, STARTS)
    .map(({ pitch, roll, prior }) => {
      const scored = YAWS.map((yaw) => ({
        angles: [pitch, roll, yaw] as Angles,
        score: prior + total(lines, [pitch, roll, yaw], COARSE_SIGMA),
      }));
      return scored.reduce((a, b) => (b.score > a.score ? b : a));
    });
  const kept: Angles[] = [];
  for (const { angles } of found.sort((a, b) => b.score - a.score)) {
    // Neighbours on the grid lead to the same attitude.
    if (kept.every(([pitch, roll]) => Math.max(Math.abs(angles[0] - pitch), Math.abs(angles[1] - roll)) > APART))
      kept.push(angles);
  }
  return kept.slice(0, REFINED);
}

/** Return the log likelihood of an attitude, without its prior. */
function total(lines: Line[], angles: Angles, least: number): number {
  const axes = directions(angles);
  return lines.reduce(
    (sum, line) =>
      sum +
      line.weight *
        Math.log(axes.reduce((all, axis, index) => all + SHARES[index]! * likelihood(line, axis, least), OUTLIERS)),
    0,
  );
}

/** Refine an attitude by expectation maximisation. */
function refined(lines: Line[], start: Angles): Mode {
  const prior = [1 / PRIOR[0] ** 2, 1 / PRIOR[1] ** 2, 0];
  let angles = start,
    information: number[][] = [],
    least = SIGMA;
  for (let step = 0; step < STEPS; step++) {
    least = Math.max(SIGMA, COARSE_SIGMA * 0.7 ** step);
    const axes = directions(angles);
    const turned = [0, 1, 2].map((axis) =>
      directions(angles.map((value, index) => value + (index === axis ? DELTA : 0)) as Angles),
    );
    information = prior.map((value, row) => prior.map((_, column) => (row === column ? value + 1e-3 : 0)));
    const gradient = prior.map((value, axis) => value * angles[axis]!);
    for (const line of lines) {
      const sigma = Math.hypot(least, line.blur),
        apart = axes.map((axis) => distance(line, axis));
      const errors = axes.map((axis, index) => dot(line.normal, axis) / apart[index]!);
      const densities = errors.map((error, index) => SHARES[index]! * density(error, sigma));
      const sum = densities.reduce((a, b) => a + b) + OUTLIERS;
      axes.forEach((axis, index) => {
        const share = (line.weight * densities[index]!) / sum / sigma ** 2;
        const slopes = turned.map(
          (moved) => (dot(line.normal, moved[index]!) - dot(line.normal, axis)) / DELTA / apart[index]!,
        );
        slopes.forEach((slope, row) => {
          gradient[row]! += share * slope * errors[index]!;
          slopes.forEach((other, column) => {
            information[row]![column]! += share * slope * other;
          });
        });
      });
    }
    const inverse = inverted(information);
    angles = angles.map(
      (value, row) => value - inverse[row]!.reduce((sum, entry, column) => sum + entry * gradient[column]!, 0),
    ) as Angles;
  }
  const inverse = inverted(information);
  const score =
    total(lines, angles, least) - 0.5 * prior.reduce((sum, value, axis) => sum + value * angles[axis]! ** 2, 0);
  return { angles, score, variance: [inverse[0]![0]!, inverse[1]![1]!, inverse[2]![2]!] };
}

/** Return the inverse of a symmetric 3 x 3 matrix. */
function inverted(m: number[][]): number[][] {
  const minor = (row: number, column: number): number => {
    const [r, s] = [0, 1, 2].filter((index) => index !== row),
      [c, d] = [0, 1, 2].filter((index) => index !== column);
    return (m[r!]![c!]! * m[s!]![d!]! - m[r!]![d!]! * m[s!]![c!]!) * ((row + column) % 2 === 0 ? 1 : -1);
  };
  const determinant = [0, 1, 2].reduce((sum, column) => sum + m[0]![column]! * minor(0, column), 0);
  return [0, 1, 2].map((row) => [0, 1, 2].map((column) => minor(column, row) / determinant));
}
