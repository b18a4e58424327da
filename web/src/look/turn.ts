/** Turn of the camera: which frames to take, how far around it is, and a hint for what goes wrong. */

import type { Judged } from "./frames";
import type { Attitude } from "./orientation";

// Field of view (degrees) that is presumed of phones, upright and lying.
const UPRIGHT_DEG = 53,
  LYING_DEG = 67;
// Angle between frames as a share of the field of view, and of that angle, the least distance from each frame.
const STEP = 0.45,
  APART = 0.85;
const MAX_FRAMES = 30;
// Limits: grey value, turn per second (degrees), tilts (degrees), and sharpness as a share of the usual one.
const DARK = 35,
  FAST = 60,
  STEADY = 40,
  PITCHED = 25,
  ROLLED = 15,
  SHARP = 0.6;
const USUAL = 0.1;

export interface Moment {
  judged: Judged;
  attitude: Attitude | null;
  isWalking: boolean;
  /** Seconds since the moment before; 0 for the first. */
  passed: number;
  isUpright: boolean;
}

export type Hint = "dark" | "fast" | "tilted" | "walking" | "turn" | "hold" | "done";

export const HINTS: Record<Hint, string> = {
  dark: "Too dark: switch on a light.",
  fast: "Too fast: turn more slowly.",
  tilted: "Hold the phone upright, and level.",
  walking: "Stay on the spot: turn without walking.",
  turn: "Turn slowly to the right.",
  hold: "Hold still for a moment.",
  done: "All around: finding the place.",
};

/** Return an angle between -180° and 180°. */
export const wrapped = (angle: number): number => ((((angle + 180) % 360) + 360) % 360) - 180;

export class Turn {
  /** Direction of the camera, degrees clockwise from where it first looked. */
  yaw = 0;
  /** Directions of the frames that were taken. */
  readonly taken: number[] = [];
  /** The gyroscope told all directions. */
  hasGyroscope = true;
  private first: number | null = null;
  private usual = 0;
  private rate = 0;
  private step = STEP * UPRIGHT_DEG;

  /** Go on by a moment; return what to say. */
  follow({ judged, attitude, isWalking, passed, isUpright }: Moment): Hint {
    const field = isUpright ? UPRIGHT_DEG : LYING_DEG;
    this.step = STEP * field;
    const before = this.yaw;
    if (attitude === null) {
      this.yaw += judged.shift * field;
    } else {
      // The direction of the gyroscope goes on where the picture's ended.
      this.first ??= attitude.yaw - this.yaw;
      this.yaw += wrapped(attitude.yaw - this.first - this.yaw);
    }
    this.rate = passed > 0 ? Math.abs(this.yaw - before) / passed : 0;
    this.usual += (this.usual === 0 ? 1 : USUAL) * (judged.sharpness - this.usual);
    if (this.isAround) return "done";
    if (judged.brightness < DARK) return "dark";
    if (isWalking) return "walking";
    if (this.rate > FAST) return "fast";
    if (attitude !== null && (Math.abs(attitude.pitch) > PITCHED || Math.abs(attitude.roll) > ROLLED)) return "tilted";
    if (!this.isNew) return "turn";
    return this.rate > STEADY || judged.sharpness < SHARP * this.usual ? "hold" : "turn";
  }

  /** True if a frame is to be taken now, by the hint of this moment. */
  wants(hint: Hint): boolean {
    return hint === "turn" && this.isNew && this.taken.length < MAX_FRAMES;
  }

  /** Note that a frame was taken, and by which attitude. */
  take(attitude: Attitude | null): void {
    this.taken.push(this.yaw);
    this.hasGyroscope &&= attitude !== null;
  }

  /** True if frames were taken all around. */
  get isAround(): boolean {
    if (this.taken.length >= MAX_FRAMES) return true;
    if (this.taken.length < 4) return false;
    const sorted = this.taken.map((yaw) => ((yaw % 360) + 360) % 360).sort((a, b) => a - b);
    const gaps = sorted.map((yaw, index) => (sorted[index + 1] ?? sorted[0]! + 360) - yaw);
    return Math.max(...gaps) <= 1.6 * this.step;
  }

  /** Half the angle (degrees) that a frame fills of the ring. */
  get halfStep(): number {
    return 0.6 * this.step;
  }

  private get isNew(): boolean {
    return this.taken.every((yaw) => Math.abs(wrapped(yaw - this.yaw)) >= APART * this.step);
  }
}
