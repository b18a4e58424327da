/** Photo Sphere Viewer, in a file of its own that is loaded with the first picture. */

import { type PanoData, Viewer } from "@photo-sphere-viewer/core";

import { radians } from "./layout";
import type { Gaze } from "./projection";

/** Viewer of full spheres. */
export class Sphere {
  private readonly viewer: Viewer;
  private shown: string | null = null;

  constructor(container: HTMLElement, rendered: () => void) {
    this.viewer = new Viewer({
      container,
      navbar: false,
      keyboard: false,
      defaultZoomLvl: 0,
      minFov: 35,
      maxFov: 85,
      moveInertia: false,
      loadingTxt: "",
      // The picture's centre stays at yaw 0, as the service computes the heading; the horizon is levelled as in the service.
      panoData: (image, xmp) => ({ ...(contradicts(xmp ?? {}) ? centred(image) : xmp), poseHeading: 0 }) as PanoData,
    });
    this.viewer.addEventListener("render", rendered);
  }

  async show(url: string): Promise<void> {
    if (this.shown === url) return;
    this.shown = url;
    await this.viewer.setPanorama(url, { transition: false, showLoader: false, position: { yaw: 0, pitch: 0 } });
  }

  gaze(): Gaze {
    const { yaw, pitch } = this.viewer.getPosition();
    return { yaw, pitch, verticalFov: radians(this.viewer.state.vFov) };
  }

  turnBy(yaw: number, pitch: number): void {
    const now = this.viewer.getPosition();
    this.viewer.rotate({ yaw: now.yaw + yaw, pitch: Math.max(-1.5, Math.min(1.5, now.pitch + pitch)) });
  }

  zoomBy(steps: number): void {
    this.viewer.zoom(this.viewer.getZoomLevel() + steps);
  }
}

/** Return true if a picture is not within the full sphere that its metadata state. */
function contradicts(place: Partial<PanoData>): boolean {
  const fullWidth = place.fullWidth ?? 2 * (place.fullHeight ?? Infinity),
    fullHeight = place.fullHeight ?? 0.5 * fullWidth,
    left = place.croppedX ?? 0,
    top = place.croppedY ?? 0;
  if (Math.min(left, top) < 0 || Math.abs(fullWidth - 2 * fullHeight) > 1) return true;
  return left + (place.croppedWidth ?? 0) > fullWidth || top + (place.croppedHeight ?? 0) > fullHeight;
}

/** Return the place of a picture in the middle of a sphere, as large as it can be. */
function centred({ width, height }: HTMLImageElement): Partial<PanoData> {
  const fullHeight = Math.max(height, Math.ceil(0.5 * width)),
    fullWidth = 2 * fullHeight;
  return {
    fullWidth,
    fullHeight,
    croppedWidth: width,
    croppedHeight: height,
    croppedX: Math.floor(0.5 * (fullWidth - width)),
    croppedY: Math.floor(0.5 * (fullHeight - height)),
  };
}
