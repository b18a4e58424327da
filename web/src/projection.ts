/** Projection of directions in a sphere to the screen, for the viewer and the flat picture. */

import type { Point } from "./types";

/** Direction of the viewer: yaw from the picture's centre, pitch up, vertical field of view; radians. */
export interface Gaze {
  yaw: number;
  pitch: number;
  verticalFov: number;
}

export interface Size {
  width: number;
  height: number;
}

const NEAR = 0.02;
type Vector = [number, number, number];

/** Project a line of (yaw, elevation) as a camera sees it; parts behind it are cut off. */
export function perspective(line: Point[], gaze: Gaze, size: Size): Point[][] {
  const focal = (0.5 * size.height) / Math.tan(0.5 * gaze.verticalFov);
  const sine = Math.sin(gaze.pitch),
    cosine = Math.cos(gaze.pitch);
  const turned = ([yaw, elevation]: Point): Vector => {
    const right = Math.cos(elevation) * Math.sin(yaw - gaze.yaw);
    const forward = Math.cos(elevation) * Math.cos(yaw - gaze.yaw);
    const up = Math.sin(elevation);
    return [right, up * cosine - forward * sine, forward * cosine + up * sine];
  };
  const onScreen = ([right, up, forward]: Vector): Point => [
    0.5 * size.width + (focal * right) / forward,
    0.5 * size.height - (focal * up) / forward,
  ];
  return inFront(line.map(turned)).map((piece) => piece.map(onScreen));
}

function inFront(line: Vector[]): Vector[][] {
  const pieces: Vector[][] = [];
  let piece: Vector[] = [];
  line.forEach((point, index) => {
    const previous = line[index - 1];
    if (previous !== undefined && previous[2] >= NEAR !== point[2] >= NEAR) {
      const share = (NEAR - previous[2]) / (point[2] - previous[2]);
      piece.push(previous.map((value, axis) => value + share * (point[axis]! - value)) as Vector);
    }
    if (point[2] >= NEAR) piece.push(point);
    else if (piece.length > 0) {
      pieces.push(piece);
      piece = [];
    }
  });
  if (piece.length > 0) pieces.push(piece);
  return pieces;
}

/** Project the same line to the flat picture; one that crosses its edge is cut in two. */
export function equirectangular(line: Point[], size: Size): Point[][] {
  const place = ([yaw, elevation]: Point, turns: number): Point => [
    ((yaw - turns * 2 * Math.PI) / (2 * Math.PI) + 0.5) * size.width,
    (0.5 - elevation / Math.PI) * size.height,
  ];
  const turnOf = ([yaw]: Point): number => Math.floor((yaw + Math.PI) / (2 * Math.PI));
  const pieces: Point[][] = [[]];
  line.forEach((point, index) => {
    const turn = turnOf(point),
      previous = line[index - 1];
    if (previous !== undefined && turnOf(previous) !== turn) {
      // Both parts continue beyond their edge of the canvas.
      pieces.at(-1)!.push(place(point, turnOf(previous)));
      pieces.push([place(previous, turn)]);
    }
    pieces.at(-1)!.push(place(point, turn));
  });
  return pieces;
}
