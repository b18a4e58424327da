/** Lines of the plan over the live picture of a camera that turns on the spot. */

import { type CameraView, throughCamera } from "../camera";
import { type LayoutLine, radians } from "../layout";
import { strokeLines } from "../layout_strokes";
import type { Point, ViewAnswer } from "../types";
import type { Attitude } from "./orientation";

/** Answer to the first frame: its view, heading (degrees) and the lines around its place. */
export interface LiveAnswer {
  view: ViewAnswer;
  heading: number;
  lines: LayoutLine[];
}

/** Draw the lines as the camera sees them, turned by `yaw` degrees from the first frame. */
export function drawLive(
  canvas: HTMLCanvasElement,
  video: HTMLVideoElement,
  { view, heading, lines }: LiveAnswer,
  yaw: number,
  attitude: Attitude | null,
): void {
  const sharp = window.devicePixelRatio || 1,
    size = { width: video.clientWidth, height: video.clientHeight };
  canvas.width = Math.round(size.width * sharp);
  canvas.height = Math.round(size.height * sharp);
  canvas.style.width = `${size.width}px`;
  canvas.style.height = `${size.height}px`;
  const context = canvas.getContext("2d");
  if (context === null) return;
  context.scale(sharp, sharp);
  const tilted: CameraView =
    attitude === null
      ? view
      : {
          ...view,
          pitch: { ...view.pitch, value_deg: attitude.pitch },
          roll: { ...view.roll, value_deg: attitude.roll },
        };
  const middle = radians(heading + yaw);
  strokeLines(
    context,
    lines.map(({ kind, points }) => ({
      kind,
      pieces: throughCamera(
        points.map(([azimuth, elevation]): Point => [azimuth - middle, elevation]),
        tilted,
        size,
      ),
    })),
  );
}
