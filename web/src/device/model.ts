/** Image encoder of the service's model in onnxruntime-web, as in lalaloc_core/localise/encode/features.py. */

import { sha256 } from "@noble/hashes/sha2";
import { bytesToHex } from "@noble/hashes/utils";
import * as ort from "onnxruntime-web/wasm";

import { InputError } from "../input_error";
import { radians } from "../layout";
import type { Size } from "../projection";
import type { PatchSize } from "./patches";

/** Parts of the manifest that are used. */
export interface Manifest {
  name: string;
  files: Record<string, { bytes: number; sha256: string }>;
  image_height: number;
  image_width: number;
  profile_columns: number;
  ring_sectors: number | null;
  room_types: string[];
  image_config: { modes?: number };
  objects?: { names: string[] } | null;
  view: { image_height: number; image_width: number; sectors: number; top_deg: number } | null;
}

type Outputs = Record<string, Float32Array>;

const RUNTIME = "/web/onnxruntime.wasm.gz",
  RUNTIME_SCRIPT = "/web/onnxruntime.js";
const SPHERES = "image_encoder.onnx",
  VIEWS = "view_encoder.onnx",
  OBJECTS = "objects.onnx";
// The service packs networks: gzip of the even bytes and then the odd ones.
const PACKED = ".planes.gz";
// As in lalaloc_core: camera heights (m) of the rings, the height of all other outputs, and the patches read at once.
const HEIGHTS_M = [0.5, 1, 1.5, 2, 3],
  HEIGHT_M = 1,
  BATCH = 4;
const PROFILE = ["log_profile", "log_scale"],
  MIXTURE = [...PROFILE, "log_share"];
const STRUCTURE = ["opening_logits", "log_ceiling", "log_ceiling_scale", "room_type_logits"];
const BY_COLUMN = [...MIXTURE, "opening_logits"];

export class Model {
  readonly digest: string;
  private readonly sessions = new Map<string, Promise<ort.InferenceSession>>();

  /** `load` returns a file of the model. */
  constructor(
    readonly manifest: Manifest,
    private readonly load: (name: string) => Promise<ArrayBuffer>,
  ) {
    const lines = Object.keys(manifest.files)
      .sort()
      .map((name) => `${name} ${manifest.files[name]!.sha256}`);
    this.digest = bytesToHex(sha256(new TextEncoder().encode(lines.join("\n"))));
  }

  get patchSize(): PatchSize {
    const { view, ring_sectors: sectors, profile_columns: columns } = this.manifest;
    if (view === null || sectors === null)
      throw new InputError(`The service’s model “${this.manifest.name}” gives features of full 360° photographs only.`);
    const hfov = (2 * Math.PI * view.sectors) / sectors;
    return {
      width: view.image_width,
      height: view.image_height,
      hfov,
      top: radians(view.top_deg),
      step: (2 * Math.PI) / columns,
    };
  }

  /** Return the arrays of a sphere: rings for all heights, then means over the picture and its mirror image. */
  async sphere(rgb: Uint8ClampedArray): Promise<Float32Array[]> {
    const { image_height: height, image_width: width, ring_sectors: sectors, room_types: types } = this.manifest;
    if (sectors === null || types.length === 0)
      throw new InputError(`The service’s model “${this.manifest.name}” gives no features of 360° photographs.`);
    const walls = this.manifest.image_config.modes === 2 ? MIXTURE : PROFILE;
    const size = [height, width, 3],
      names = [...walls, ...STRUCTURE];
    const both = new Uint8Array(2 * rgb.length);
    both.set(rgb);
    for (let pixel = 0; pixel < height * width; pixel++) {
      const mirrored = pixel - (pixel % width) + (width - 1 - (pixel % width));
      for (let c = 0; c < 3; c++) both[rgb.length + 3 * pixel + c] = rgb[3 * mirrored + c]!;
    }
    const outputs = await this.run(SPHERES, both, [2, ...size], HEIGHT_M, ["ring", ...names]);
    const ring = outputs.ring!.slice(0, outputs.ring!.length / 2),
      rings = new Float32Array(HEIGHTS_M.length * ring.length);
    for (const [index, metres] of HEIGHTS_M.entries()) {
      const own =
        metres === HEIGHT_M
          ? ring
          : (await this.run(SPHERES, both.subarray(0, rgb.length), [1, ...size], metres, ["ring"])).ring!;
      rings.set(own, index * ring.length);
    }
    return [
      rings,
      ...names.map((name) => mean(outputs[name]!, BY_COLUMN.includes(name) ? this.manifest.profile_columns : 1)),
    ];
  }

  /** Return the arrays of level patches. */
  async patches(patches: Uint8Array[]): Promise<Float32Array[]> {
    const { width, height } = this.patchSize,
      names = [...MIXTURE, "seen", ...STRUCTURE];
    const parts: Outputs[] = [];
    for (let first = 0; first < patches.length; first += BATCH) {
      const batch = patches.slice(first, first + BATCH),
        images = new Uint8Array(4 * width * height * batch.length);
      batch.forEach((patch, index) => images.set(patch, index * patch.length));
      parts.push(await this.run(VIEWS, images, [batch.length, height, width, 4], HEIGHT_M, names));
    }
    return names.map((name) => Float32Array.from(parts.flatMap((part) => [...part[name]!])));
  }

  /** Return probability and azimuth of each object in a picture with the given azimuths of columns; 0 for those of the detector, which does not run here. */
  async objects(rgb: Uint8ClampedArray, { width, height }: Size, azimuths: number[]): Promise<Float32Array[]> {
    if (!this.manifest.objects) return [];
    const names = ["probability", "by_column"],
      outputs = await this.run(OBJECTS, new Uint8Array(rgb), [1, height, width, 3], HEIGHT_M, names);
    const probability = outputs.probability!,
      byColumn = outputs.by_column!,
      columns = azimuths.length;
    const places = Float32Array.from(this.manifest.objects.names, (_, object) => {
      const row = byColumn.subarray(object * columns, (object + 1) * columns);
      return azimuths[row.indexOf(Math.max(...row))] ?? 0;
    });
    return [places.map((_, object) => probability[object] ?? 0), places];
  }

  private async run(
    file: string,
    images: Uint8Array,
    size: number[],
    heightM: number,
    names: string[],
  ): Promise<Outputs> {
    if (!this.sessions.has(file)) this.sessions.set(file, this.session(file));
    const session = await this.sessions.get(file)!.catch((error: unknown) => {
      // The file can arrive undamaged next time.
      this.sessions.delete(file);
      throw error;
    });
    const feeds: Record<string, ort.Tensor> = { image: new ort.Tensor("uint8", images, size) };
    if (session.inputNames.includes("camera_height_m"))
      feeds.camera_height_m = new ort.Tensor("float32", new Float32Array(size[0]!).fill(heightM), [size[0]!]);
    const outputs = await session.run(feeds, names);
    return Object.fromEntries(names.map((name) => [name, outputs[name]!.data as Float32Array]));
  }

  private async session(file: string): Promise<ort.InferenceSession> {
    const entry = this.manifest.files[file];
    if (entry === undefined) throw new InputError(`The service’s model “${this.manifest.name}” has no ${file}.`);
    const [packed] = await Promise.all([this.load(file + PACKED), startRuntime()]);
    const content = await unpacked(packed),
      digest = bytesToHex(sha256(content));
    if (digest !== entry.sha256) {
      throw new InputError(
        `The service sent ${file} with the SHA-256 ${digest.slice(0, 12)}…; its model states ${entry.sha256.slice(0, 12)}…. Load the page again.`,
      );
    }
    return ort.InferenceSession.create(content, { executionProviders: ["wasm"], logSeverityLevel: 3 });
  }
}

/** Return the mean of an output and of that of the mirror image, whose azimuth columns are in reverse order. */
function mean(outputs: Float32Array, columns: number): Float32Array {
  const length = outputs.length / 2,
    perColumn = length / columns;
  return Float32Array.from({ length }, (_, index) => {
    const column = Math.floor(index / perColumn);
    return 0.5 * (outputs[index]! + outputs[length + (columns - 1 - column) * perColumn + (index % perColumn)]!);
  });
}

/** Return a file that the service has packed. */
async function unpacked(packed: ArrayBuffer): Promise<Uint8Array<ArrayBuffer>> {
  const planes = new Uint8Array(await unzipped(new Blob([packed]).stream())),
    content = new Uint8Array(planes.length),
    even = Math.ceil(planes.length / 2);
  for (let index = 0; index < even; index++) content[2 * index] = planes[index]!;
  for (let index = even; index < planes.length; index++) content[2 * (index - even) + 1] = planes[index]!;
  return content;
}

/** Unzip here, because not every proxy passes compressed files on. */
const unzipped = (stream: ReadableStream<Uint8Array<ArrayBuffer>>): Promise<ArrayBuffer> =>
  new Response(stream.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();

let runtime: Promise<void> | null = null;

/** Load the runtime once. */
function startRuntime(): Promise<void> {
  return (runtime ??= (async () => {
    const answer = await fetch(RUNTIME);
    if (!answer.ok) throw new Error(`the service answered ${answer.status} for ${RUNTIME}`);
    ort.env.wasm.wasmBinary = await unzipped(answer.body!);
    ort.env.wasm.wasmPaths = { mjs: RUNTIME_SCRIPT };
    // Threads need cross-origin isolation.
    ort.env.wasm.numThreads = 1;
  })());
}
