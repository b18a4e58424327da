/** Frames of the camera, judged at low resolution: brightness, sharpness, and the turn since the frame before. */

const COLUMNS = 120;
// Turns between two frames that are recognised, as a share of the width, and the columns that must be left to compare.
const FARTHEST = 0.3;
// Longer side of a frame that is taken, pixels.
const TAKEN = 1440;

export interface Judged {
  /** Mean grey value, 0 to 255. */
  brightness: number;
  /** Mean difference of neighbouring pixels over the brightness. */
  sharpness: number;
  /** Movement of the picture to the left since the frame before, as a share of its width; 0 for the first. */
  shift: number;
}

/** Judges the frames of a video one after the other. */
export class FrameJudge {
  private readonly canvas = document.createElement("canvas");
  private before: Float32Array | null = null;

  judge(video: HTMLVideoElement): Judged {
    const { videoWidth: width, videoHeight: height } = video;
    const rows = Math.max(1, Math.round((COLUMNS * height) / width));
    Object.assign(this.canvas, { width: COLUMNS, height: rows });
    const context = this.canvas.getContext("2d", { willReadFrequently: true })!;
    context.drawImage(video, 0, 0, COLUMNS, rows);
    const grey = greyOf(context.getImageData(0, 0, COLUMNS, rows).data);
    const profile = profileOf(grey, rows),
      brightness = grey.reduce((sum, value) => sum + value, 0) / grey.length;
    const judged = {
      brightness,
      sharpness: contrast(grey, rows) / Math.max(brightness, 1),
      shift: this.before === null ? 0 : shiftOf(this.before, profile) / COLUMNS,
    };
    this.before = profile;
    return judged;
  }
}

/** Return the current frame as a JPEG file. */
export async function takeFrame(video: HTMLVideoElement, name: string): Promise<File> {
  const share = Math.min(1, TAKEN / Math.max(video.videoWidth, video.videoHeight));
  const canvas = document.createElement("canvas");
  canvas.width = Math.round(share * video.videoWidth);
  canvas.height = Math.round(share * video.videoHeight);
  canvas.getContext("2d")!.drawImage(video, 0, 0, canvas.width, canvas.height);
  const content = await new Promise<Blob | null>((done) => canvas.toBlob(done, "image/jpeg", 0.9));
  if (content === null) throw new Error("the browser could not keep a frame of the camera");
  return new File([content], name, { type: "image/jpeg" });
}

function greyOf(pixels: Uint8ClampedArray): Float32Array {
  const grey = new Float32Array(pixels.length / 4);
  for (let i = 0; i < grey.length; i++)
    grey[i] = 0.3 * pixels[4 * i]! + 0.59 * pixels[4 * i + 1]! + 0.11 * pixels[4 * i + 2]!;
  return grey;
}

/** Return mean and vertical contrast of each column, which move with the picture. */
function profileOf(grey: Float32Array, rows: number): Float32Array {
  const profile = new Float32Array(2 * COLUMNS);
  for (let column = 0; column < COLUMNS; column++) {
    let sum = 0,
      change = 0;
    for (let row = 0; row < rows; row++) {
      const value = grey[row * COLUMNS + column]!;
      sum += value;
      if (row > 0) change += Math.abs(value - grey[(row - 1) * COLUMNS + column]!);
    }
    profile[column] = sum / rows;
    profile[COLUMNS + column] = (4 * change) / rows;
  }
  return profile;
}

function contrast(grey: Float32Array, rows: number): number {
  let sum = 0;
  for (let row = 0; row < rows; row++)
    for (let column = 1; column < COLUMNS; column++)
      sum += Math.abs(grey[row * COLUMNS + column]! - grey[row * COLUMNS + column - 1]!);
  return sum / (rows * (COLUMNS - 1));
}

/** Return the columns by which a picture moved to the left, with a fraction. */
export function shiftOf(before: Float32Array, after: Float32Array): number {
  const farthest = Math.round(FARTHEST * COLUMNS);
  const costs: number[] = [];
  for (let shift = -farthest; shift <= farthest; shift++) {
    let sum = 0,
      count = 0;
    for (let column = Math.max(0, -shift); column < Math.min(COLUMNS, COLUMNS - shift); column++)
      for (const offset of [0, COLUMNS]) {
        sum += Math.abs(before[offset + column + shift]! - after[offset + column]!);
        count++;
      }
    costs.push(sum / count);
  }
  const best = costs.indexOf(Math.min(...costs));
  const [left, middle, right] = [costs[best - 1], costs[best]!, costs[best + 1]];
  // A parabola through the neighbours gives the fraction.
  const bend = left === undefined || right === undefined ? 0 : left - 2 * middle + right;
  return best - farthest + (bend > 0 ? (0.5 * (left! - right!)) / bend : 0);
}
