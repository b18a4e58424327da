/** Worker that computes features of photographs, with a content security policy of its own that allows WebAssembly. */

import type { CameraView } from "../camera";
import { InputError } from "../input_error";
import { degrees } from "../layout";
import { type Attitude, estimateAttitude, estimateCalibration, MAX_ESTIMATED_SD } from "./attitude";
import { type Header, featuresFile } from "./features_file";
import { findLens, type Lens, poseAngle, type Stated } from "./lens";
import { type Metadata, readMetadata } from "./metadata";
import { type Manifest, Model } from "./model";
import { columnAzimuths, thumbnailSize } from "./objects";
import { cutPatch, FINER, patchSteps, seenDeg } from "./patches";
import { decoded, levelled, looksSpherical, scaled } from "./pixels";
import { findSegments } from "./segments";

/** Messages to the worker: a photograph, or a file of the model that it needs. */
export type Task =
  { kind: "encode"; file: File; stated: Stated; manifest: Manifest } | { kind: "file"; content: ArrayBuffer };
type Features = Uint8Array<ArrayBuffer>;
/** Messages from the worker. */
export type Result =
  | { kind: "need"; name: string }
  | { kind: "done"; features: Features }
  | { kind: "failed"; message: string; isInput: boolean };

type Angle = Header["pitch"];

// Standard deviations (degrees) of stated angles, and of pitch and roll of handheld cameras.
const GIVEN_SD_DEG = 0.5,
  PITCH_SD_DEG = 12,
  ROLL_SD_DEG = 4;
// Longer side of pictures in which lines are found.
const LINES_SIDE = 640;
const MIN_PIXELS = 64,
  MAX_PITCH_DEG = 60,
  MAX_ROLL_DEG = 180,
  JUDGED = { width: 256, height: 128 };
// Pixels of a column in which the classifier of objects finds them.
const OBJECT_COLUMN = 32;
// Photographs are scaled down if they are finer than this times the need.
const SMALLEST_REDUCTION = 0.85;
const NOT_ESTIMATED =
  "pitch and roll of the strip count as 0, because the browser does not estimate them; send pitch_deg and roll_deg (0 for a level camera) for a surer answer";

const scope = self as unknown as {
  onmessage: (event: MessageEvent<Task>) => void;
  postMessage: (result: Result) => void;
};
let model: Model | null = null;
let received: (content: ArrayBuffer) => void = () => undefined;

function load(name: string): Promise<ArrayBuffer> {
  return new Promise((done) => {
    received = done;
    scope.postMessage({ kind: "need", name });
  });
}

scope.onmessage = ({ data }) => {
  if (data.kind === "file") received(data.content);
  else {
    if (model === null || JSON.stringify(model.manifest) !== JSON.stringify(data.manifest))
      model = new Model(data.manifest, load);
    encode(data.file, data.stated, model).then(
      (features) => scope.postMessage({ kind: "done", features }),
      (error: unknown) =>
        scope.postMessage({
          kind: "failed",
          message: error instanceof Error ? error.message : String(error),
          isInput: error instanceof InputError,
        }),
    );
  }
};

async function encode(file: File, stated: Stated, encoder: Model): Promise<Features> {
  const metadata = readMetadata(await file.arrayBuffer()),
    bitmap = await decoded(file, file.name);
  try {
    if (Math.min(bitmap.width, bitmap.height) < MIN_PIXELS) {
      throw new InputError(
        `The photograph is ${bitmap.width} × ${bitmap.height}; the minimum is ${MIN_PIXELS} pixels on each side.`,
      );
    }
    const lens = findLens(bitmap, stated, metadata, () => looksSpherical(scaled(bitmap, JUDGED.width, JUDGED.height)));
    const shown = { bitmap, lens, stated, metadata };
    return await (lens.projection === "equirectangular" ? sphere : patched)(shown, encoder);
  } finally {
    bitmap.close();
  }
}

interface Photograph {
  bitmap: ImageBitmap;
  lens: Lens;
  stated: Stated;
  metadata: Metadata;
}

async function sphere({ bitmap, lens, stated, metadata }: Photograph, encoder: Model): Promise<Features> {
  const tilt = (entered: Angle | null, name: string, most: number): Angle => {
    const value_deg = poseAngle(metadata, name, -most, most) ?? 0;
    return entered ?? { value_deg, std_deg: GIVEN_SD_DEG, source: value_deg === 0 ? "assumed" : "gpano" };
  };
  const pitch = tilt(statedPitch(stated), "PosePitchDegrees", 90),
    roll = tilt(statedRoll(stated), "PoseRollDegrees", 180);
  const { image_width: width, image_height: height } = encoder.manifest,
    isLevel = pitch.value_deg === 0 && roll.value_deg === 0;
  const pixels = isLevel
    ? scaled(bitmap, width, height)
    : levelled(scaled(bitmap, 2 * width, 2 * height), { projection: lens.projection, pitch, roll });
  const header: Header = {
    ...common(lens, encoder),
    hfov: { value_deg: 360, std_deg: 0, source: lens.hfovSource },
    pitch,
    roll,
    wall_direction: null,
    seen_deg: [-180, 180],
    patches: [],
    compass_deg: poseAngle(metadata, "PoseHeadingDegrees", 0, 360),
    camera: null,
  };
  return featuresFile(header, await encoder.sphere(pixels.rgb));
}

async function patched({ bitmap, lens: known, stated }: Photograph, encoder: Model): Promise<Features> {
  const { width, height } = bitmap,
    size = encoder.patchSize,
    entered = [statedPitch(stated), statedRoll(stated)] as const;
  const { lens, lined } = withLines(bitmap, known),
    { projection, hfov } = lens;
  const isPerspective = projection === "perspective",
    focal = isPerspective ? (0.5 * width) / Math.tan(0.5 * hfov) : width / hfov;
  const isAssumed = entered.includes(null) && !isPerspective;
  const level = (std_deg: number): Angle => ({ value_deg: 0, std_deg, source: "assumed" });
  const view: CameraView = {
    projection,
    camera: isPerspective
      ? { width, height, fx: focal, fy: focal, cx: 0.5 * width - 0.5, cy: 0.5 * height - 0.5, distortion: [] }
      : null,
    hfov: {
      value_deg: degrees(hfov),
      std_deg: degrees(lens.focalSd * (isPerspective ? Math.sin(hfov) : hfov)),
      source: lens.hfovSource,
    },
    pitch: entered[0] ?? lined?.pitch ?? level(PITCH_SD_DEG),
    roll: entered[1] ?? lined?.roll ?? level(ROLL_SD_DEG),
  };
  const wanted = (FINER * size.width) / size.hfov / focal,
    share = wanted > SMALLEST_REDUCTION ? 1 : wanted;
  const picture = scaled(bitmap, Math.max(1, Math.round(share * width)), Math.max(1, Math.round(share * height)));
  const steps = patchSteps(hfov, size);
  const shown = thumbnailSize(bitmap),
    thumbnail = scaled(bitmap, shown.width, shown.height);
  const arrays = [
    ...(await encoder.patches(steps.map((step) => cutPatch(picture, view, step * size.step, size)))),
    ...(await encoder.objects(thumbnail.rgb, shown, columnAzimuths(view, shown.width / OBJECT_COLUMN))),
  ];
  const header: Header = {
    ...common(lens, encoder),
    hfov: view.hfov,
    pitch: view.pitch,
    roll: view.roll,
    wall_direction: lined?.wall_direction ?? null,
    seen_deg: seenDeg(view),
    patches: steps,
    compass_deg: null,
    camera:
      view.camera === null
        ? null
        : { width, height, intrinsics: { fx: focal, fy: focal, cx: view.camera.cx, cy: view.camera.cy } },
    warnings: [...lens.warnings, ...(isAssumed ? [NOT_ESTIMATED] : [])],
  };
  return featuresFile(header, arrays);
}

/** What the straight lines of a photograph tell. */
type Lined = Pick<Header, "pitch" | "roll" | "wall_direction">;

/** Return the lens of a photograph, estimated if it is not known, and what the straight lines of an ordinary one tell. */
function withLines(bitmap: ImageBitmap, lens: Lens): { lens: Lens & { hfov: number }; lined: Lined | null } {
  const { hfov } = lens;
  if (hfov !== null && lens.projection !== "perspective") return { lens: { ...lens, hfov }, lined: null };
  const share = Math.min(1, LINES_SIDE / Math.max(bitmap.width, bitmap.height));
  const picture = scaled(bitmap, Math.round(share * bitmap.width), Math.round(share * bitmap.height)),
    segments = findSegments(picture);
  if (hfov !== null) return { lens: { ...lens, hfov }, lined: linedBy(estimateAttitude(segments, picture, hfov)) };
  const found = estimateCalibration(segments, picture),
    spread = 2 * found.focalSd * Math.sin(found.hfov);
  const warning =
    `the field of view of ${degrees(found.hfov).toFixed(0)}° ± ${degrees(spread).toFixed(0)}° ` +
    `${segments.length > 0 ? "was estimated from straight lines" : "is only usual"}; state hfov_deg, or send the camera's original file`;
  return {
    lens: { ...lens, hfov: found.hfov, focalSd: found.focalSd, warnings: [...lens.warnings, warning] },
    lined: linedBy(found.attitude),
  };
}

function linedBy({ pitch, roll, yaw, pitchSd, rollSd, yawSd }: Attitude): Lined {
  const angle = (value: number, sd: number): Angle => ({
    value_deg: degrees(value),
    std_deg: degrees(sd),
    source: sd < MAX_ESTIMATED_SD ? "estimated" : "assumed",
  });
  const walls: Angle = { value_deg: degrees(yaw), std_deg: degrees(yawSd), source: "estimated" };
  return { pitch: angle(pitch, pitchSd), roll: angle(roll, rollSd), wall_direction: yawSd < Math.PI ? walls : null };
}

const common = (lens: Lens, { digest }: Model) => ({
  model: digest,
  projection: lens.projection,
  projection_source: lens.projectionSource,
  warnings: lens.warnings,
});

const statedPitch = ({ pitch_deg }: Stated): Angle | null => givenAngle("Tilted up by", pitch_deg, MAX_PITCH_DEG);
const statedRoll = ({ roll_deg }: Stated): Angle | null => givenAngle("Leaning right by", roll_deg, MAX_ROLL_DEG);

function givenAngle(name: string, text: string | undefined, limit: number): Angle | null {
  if (text === undefined) return null;
  const value_deg = Number(text);
  if (!(Math.abs(value_deg) <= limit))
    throw new InputError(`“${name}” is ${text}°; it must be between −${limit}° and ${limit}°.`);
  return { value_deg, std_deg: GIVEN_SD_DEG, source: "given" };
}
