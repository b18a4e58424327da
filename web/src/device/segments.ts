/** Straight line segments of a picture, after von Gioi et al., "LSD", PAMI 2010: connected pixels whose edges have one direction. */

import type { Pixels } from "./pixels";

/** Ends (x, y, x, y), pixels from the top left corner. */
export type Segment = [number, number, number, number];

const TOLERANCE = (22.5 / 180) * Math.PI,
  LEAST_DENSITY = 0.7,
  LEAST_PIXELS = 15,
  CLOSER = 0.75;
// Gradients below this (grey levels) have no sure direction: an error of 2 levels turns them by the tolerance.
const LEAST_GRADIENT = 2 / Math.sin(TOLERANCE);
// As in lalaloc_core/photograph/levelling.py.
const MIN_LENGTH = 0.025,
  MAX_SEGMENTS = 150;
const NONE = 10;

/** Return the longest segments of a picture. */
export function findSegments(picture: Pixels): Segment[] {
  const { width, height } = picture,
    edges = edgesOf(picture);
  const seeds = Array.from(edges.strength.keys())
    .filter((index) => edges.angle[index] !== NONE)
    .sort((a, b) => edges.strength[b]! - edges.strength[a]!);
  const used = new Uint8Array(width * height),
    found: { segment: Segment; length: number }[] = [];
  const shortest = MIN_LENGTH * Math.max(width, height);
  for (const seed of seeds) {
    if (used[seed] === 1) continue;
    let region = grow(seed, TOLERANCE, width, edges, used),
      line = fitted(region, width, edges);
    if (region.length >= LEAST_PIXELS && line.density < LEAST_DENSITY) {
      // A curve, or two edges that touch: only pixels closer to the seed's direction.
      for (const index of region) used[index] = 0;
      region = grow(seed, 0.5 * TOLERANCE, width, edges, used);
      line = fitted(region, width, edges);
    }
    // Then only pixels closer to the seed.
    for (
      let radius = line.length;
      region.length >= LEAST_PIXELS && line.density < LEAST_DENSITY && radius > shortest;
    ) {
      radius *= CLOSER;
      const near = region.filter(
        (index) =>
          Math.hypot((index % width) - (seed % width), Math.floor(index / width) - Math.floor(seed / width)) < radius,
      );
      for (const index of region) used[index] = 0;
      for (const index of near) used[index] = 1;
      region = near;
      line = fitted(region, width, edges);
    }
    if (region.length >= LEAST_PIXELS && line.density >= LEAST_DENSITY && line.length > shortest) found.push(line);
  }
  return found
    .sort((a, b) => b.length - a.length)
    .slice(0, MAX_SEGMENTS)
    .map(({ segment }) => segment);
}

interface Edges {
  /** Direction along the edge, radians; NONE where there is none. */
  angle: Float32Array;
  strength: Float32Array;
}

/** Return the edge between each pixel and its neighbours to the right and below. */
function edgesOf({ width, height, rgb }: Pixels): Edges {
  const grey = new Float32Array(width * height);
  for (let index = 0; index < grey.length; index++)
    grey[index] = 0.299 * rgb[3 * index]! + 0.587 * rgb[3 * index + 1]! + 0.114 * rgb[3 * index + 2]!;
  const smooth = blurred(blurred(grey, width, height, 1), width, height, width);
  const angle = new Float32Array(grey.length).fill(NONE),
    strength = new Float32Array(grey.length);
  for (let y = 0; y < height - 1; y++) {
    for (let x = 0; x < width - 1; x++) {
      const index = y * width + x;
      const [a, b, c, d] = [smooth[index]!, smooth[index + 1]!, smooth[index + width]!, smooth[index + width + 1]!];
      const across = 0.5 * (b + d - a - c),
        down = 0.5 * (c + d - a - b),
        gradient = Math.hypot(across, down);
      strength[index] = gradient;
      if (gradient >= LEAST_GRADIENT) angle[index] = Math.atan2(across, -down);
    }
  }
  return { angle, strength };
}

/** Return values blurred by 1/4, 1/2, 1/4 along one axis, whose pixels are `step` apart. */
function blurred(values: Float32Array, width: number, height: number, step: number): Float32Array {
  const last = step === 1 ? width - 1 : height - 1;
  return values.map((value, index) => {
    const place = step === 1 ? index % width : Math.floor(index / width);
    const before = place > 0 ? values[index - step]! : value,
      after = place < last ? values[index + step]! : value;
    return 0.25 * before + 0.5 * value + 0.25 * after;
  });
}

/** Return the pixels that are connected with a seed, and whose direction is that of the region. */
function grow(seed: number, tolerance: number, width: number, { angle }: Edges, used: Uint8Array): number[] {
  const region = [seed];
  let direction = angle[seed]!,
    x = Math.cos(direction),
    y = Math.sin(direction);
  used[seed] = 1;
  for (let next = 0; next < region.length; next++) {
    const column = region[next]! % width;
    for (const down of [-width, 0, width]) {
      for (const across of [-1, 0, 1]) {
        const index = region[next]! + down + across;
        // Pixels of the last row and column have no direction, so that only the left border can be crossed; above and below
        // the picture, `used` is undefined.
        if ((column === 0 && across < 0) || used[index] !== 0 || angle[index] === NONE) continue;
        if (Math.abs(turn(angle[index]! - direction)) > tolerance) continue;
        used[index] = 1;
        region.push(index);
        x += Math.cos(angle[index]!);
        y += Math.sin(angle[index]!);
        direction = Math.atan2(y, x);
      }
    }
  }
  return region;
}

const turn = (angle: number): number => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));

/** Return the axis of a region, weighted by the strength of its edges, and the share of its rectangle that the region fills. */
function fitted(region: number[], width: number, { strength }: Edges) {
  let sum = 0,
    x = 0,
    y = 0;
  for (const index of region) {
    const weight = strength[index]!;
    sum += weight;
    x += weight * (index % width);
    y += weight * Math.floor(index / width);
  }
  x /= sum;
  y /= sum;
  let [xx, xy, yy] = [0, 0, 0];
  for (const index of region) {
    const weight = strength[index]! / sum,
      across = (index % width) - x,
      down = Math.floor(index / width) - y;
    xx += weight * across * across;
    xy += weight * across * down;
    yy += weight * down * down;
  }
  const axis = 0.5 * Math.atan2(2 * xy, xx - yy),
    [cosine, sine] = [Math.cos(axis), Math.sin(axis)];
  let [first, last, above, below] = [0, 0, 0, 0];
  for (const index of region) {
    const across = (index % width) - x,
      down = Math.floor(index / width) - y;
    const along = cosine * across + sine * down,
      aside = cosine * down - sine * across;
    first = Math.min(first, along);
    last = Math.max(last, along);
    above = Math.min(above, aside);
    below = Math.max(below, aside);
  }
  const length = last - first,
    density = region.length / (Math.max(length, 1) * Math.max(below - above, 1));
  // The edge of a pixel lies between it and its neighbours: at its lower right corner.
  const end = (along: number): [number, number] => [x + 1 + along * cosine, y + 1 + along * sine];
  const segment: Segment = [...end(first), ...end(last)];
  return { segment, length, density };
}
