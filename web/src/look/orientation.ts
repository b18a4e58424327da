/** Attitude of the rear camera by the phone's gyroscope, and whether the person walks. */

import { degrees, radians } from "../layout";

export interface Attitude {
  /** Azimuth of the optical axis, clockwise, from an arbitrary direction; degrees. */
  yaw: number;
  /** Elevation of the optical axis. */
  pitch: number;
  /** Clockwise rotation of the camera about it. */
  roll: number;
}

// Smoothed acceleration (m/s²) of a person who walks; of one who turns it is far smaller.
const WALKING = 1.4,
  SMOOTHING = 0.05;
// Longest wait for the first direction; devices without a gyroscope tell none.
const FIRST_MS = 1000;

interface WithPermission {
  requestPermission?: () => Promise<"granted" | "denied">;
}

const SENSORS = (): WithPermission[] =>
  [globalThis.DeviceOrientationEvent, globalThis.DeviceMotionEvent].filter(Boolean) as WithPermission[];

/** Return whether a sensor may be followed; without it there are no events, and overlap tells the angles. */
async function permitted(sensor: WithPermission): Promise<boolean> {
  try {
    return ((await sensor.requestPermission?.()) ?? "granted") === "granted";
  } catch {
    return false;
  }
}

/** Return the attitude of the rear camera for the angles of an event; `screen` is the angle of the screen. */
export function cameraAttitude(alpha: number, beta: number, gamma: number, screen: number): Attitude {
  const [a, b, c, s] = [alpha, beta, gamma, screen].map(radians) as [number, number, number, number];
  const [sa, ca, sb, cb, sc, cc] = [Math.sin(a), Math.cos(a), Math.sin(b), Math.cos(b), Math.sin(c), Math.cos(c)];
  // The camera looks along the device's -z; the rows of the rotation are east, north and up.
  const east = -(ca * sc + cc * sa * sb),
    north = -(sa * sc - ca * cc * sb),
    up = -(cb * cc);
  // Elevation of the right side of the screen, which lies along the device's x or y.
  const rising = Math.cos(s) * (-cb * sc) - Math.sin(s) * sb;
  return {
    yaw: degrees(Math.atan2(east, north)),
    pitch: degrees(Math.asin(Math.max(-1, Math.min(1, up)))),
    roll: -degrees(Math.asin(Math.max(-1, Math.min(1, rising)))),
  };
}

export class Orientation {
  /** Latest attitude; null on devices without a gyroscope, and without the permission. */
  attitude: Attitude | null = null;
  /** The permission that iOS wants was not given. */
  isDenied = false;
  private acceleration = 0;
  private onFirst: () => void = () => undefined;

  /** Ask for the permission that iOS wants, which needs the user's click, and follow the sensors; wait for the first direction. */
  async start(): Promise<void> {
    this.stop();
    this.attitude = null;
    this.acceleration = 0;
    this.isDenied = (await Promise.all(SENSORS().map(permitted))).includes(false);
    addEventListener("devicemotion", this.onMove);
    // A photograph before the first direction would leave the directions of all others unused.
    await new Promise<void>((done) => {
      addEventListener("deviceorientation", this.onTurn);
      this.onFirst = done;
      setTimeout(done, FIRST_MS);
    });
  }

  stop(): void {
    removeEventListener("deviceorientation", this.onTurn);
    removeEventListener("devicemotion", this.onMove);
  }

  get isWalking(): boolean {
    return this.acceleration > WALKING;
  }

  private readonly onTurn = ({ alpha, beta, gamma }: DeviceOrientationEvent): void => {
    if (alpha === null || beta === null || gamma === null) return;
    this.attitude = cameraAttitude(alpha, beta, gamma, globalThis.screen.orientation?.angle ?? 0);
    // Events without angles come first in some browsers.
    this.onFirst();
  };

  private readonly onMove = ({ acceleration }: DeviceMotionEvent): void => {
    if (acceleration === null) return;
    const size = Math.hypot(acceleration.x ?? 0, acceleration.y ?? 0, acceleration.z ?? 0);
    this.acceleration += SMOOTHING * (size - this.acceleration);
  };
}
