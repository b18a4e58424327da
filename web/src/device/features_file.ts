/** File of features, as in docs/reference/features.md. */

import type { ViewAnswer } from "../types";

type Angle = ViewAnswer["hfov"];

export interface Header {
  model: string;
  projection: ViewAnswer["projection"];
  projection_source: ViewAnswer["projection_source"];
  hfov: Angle;
  pitch: Angle;
  roll: Angle;
  wall_direction: Angle | null;
  seen_deg: [number, number];
  patches: number[];
  compass_deg: number | null;
  camera: { width: number; height: number; intrinsics: { fx: number; fy: number; cx: number; cy: number } } | null;
  warnings: string[];
}

const MAGIC = "LLFT",
  VERSION = 2,
  PREFIX_BYTES = 10;

/** Return a file with a header and arrays, in the order of the format. */
export function featuresFile(header: Header, arrays: Float32Array[]): Uint8Array<ArrayBuffer> {
  const text = new TextEncoder().encode(JSON.stringify(header));
  const length = PREFIX_BYTES + text.length + 4 * arrays.reduce((sum, array) => sum + array.length, 0);
  const file = new Uint8Array(length),
    view = new DataView(file.buffer);
  file.set(new TextEncoder().encode(MAGIC));
  view.setUint16(4, VERSION, true);
  view.setUint32(6, text.length, true);
  file.set(text, PREFIX_BYTES);
  let at = PREFIX_BYTES + text.length;
  for (const array of arrays)
    for (const value of array) {
      view.setFloat32(at, value, true);
      at += 4;
    }
  return file;
}
