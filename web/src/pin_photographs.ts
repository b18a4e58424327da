/** Photographs of a folder: those that are sent, in portions, and their thumbnails, which stay in the browser. */

import type { Picture, Schemas } from "../../clients/typescript/src/index";
import { api } from "./api";
import { device } from "./device/device";
import { download, h } from "./dom";
import { isPicture, nameKey, sorted } from "./drops";
import { InputError, say } from "./notices";
import type { Row } from "./pin_floors";

export interface Thumbnail {
  url: string;
  /** Height by width. */
  shape: number;
}

type Line = Schemas["AlbumLine"];

const WIDTH = 480;
const AT_ONCE = 20;
const PORTION_BYTES = 60e6;
// Files that a note names.
const MAX_NAMED = 8;

/** Return the photographs among some files in the order of their names, and a sentence on the others. */
export function photographsOf(files: File[]): { photographs: File[]; note: string | null } {
  const seen = files.filter((file) => !file.name.startsWith("."));
  // As on the command line, whose numbers the photographs then have.
  const photographs = sorted(seen.filter(isPicture), nameKey);
  const others = seen.filter((file) => !photographs.includes(file)).map(({ name }) => name),
    named = [...others.slice(0, MAX_NAMED), ...(others.length > MAX_NAMED ? ["…"] : [])].join(", ");
  const note = `Files that are empty or no JPEG, PNG, WebP or HEIC, left out: ${others.length} (${named})`;
  return { photographs, note: others.length === 0 ? null : note };
}

/** Return the photographs to send to an album: those that it has do not count for its limit, and get copies. */
export function wantedOf(photographs: File[], rows: Row[], limit: number): File[] {
  const known = new Set(rows.map(({ name }) => name));
  const fresh = photographs.filter(({ name }) => !known.has(name));
  const beyond = new Set(fresh.slice(Math.max(limit - rows.length, 0)));
  return photographs.filter((file) => !beyond.has(file));
}

/** Add photographs to an album; yield each with its line, or with the reason why there is none. */
export async function* added(album: string, files: File[]): AsyncGenerator<{ file: File; line: Line | string }> {
  await device.start();
  if (device.isOn) {
    for (const file of files) yield { file, line: await fromDevice(album, file) };
    return;
  }
  for (const part of portions(files))
    for await (const line of api.addToAlbum(album, part)) yield { file: part[line.index]!, line };
}

/** Send photographs once more; download copies with their place and a report, and say how many the page cannot send. */
export async function saveCopies(album: string, rows: Row[], known: ReadonlyMap<string, File>): Promise<void> {
  await device.start();
  if (device.isOn)
    throw new InputError("The service makes copies, but these photographs stay on your device: use lalaloc pin there.");
  const pictures = rows.filter(({ view }) => view.width !== null);
  const files = pictures.flatMap(({ id }) => known.get(id) ?? []);
  const missing = pictures.length - files.length,
    stayed = rows.length - pictures.length;
  if (files.length > 0) say(`Copying ${files.length} photographs…`);
  let count = 0;
  for (const part of portions(files)) {
    const body = new FormData();
    for (const file of part) body.append("photo", file);
    const answer = await api.request(`/albums/${album}/copies`, { method: "POST", body, timeoutMs: 0 });
    download(await answer.blob(), `copies-${++count}.zip`);
  }
  const without = [
    missing > 0 && `This page has no file of ${missing} photographs: add their folder again, nothing is added twice.`,
    stayed > 0 && `Photographs that stayed on a device: ${stayed}. There, lalaloc pin makes copies.`,
  ].filter((text) => text !== false);
  if (without.length > 0) throw new InputError(without.join(" "));
  say(`Copies of ${files.length} photographs and a report are downloaded.`);
}

function* portions(files: File[]): Generator<File[]> {
  for (let part: File[] = [], bytes = 0, index = 0; index <= files.length; index++) {
    const file = files[index];
    if (part.length > 0 && (!file || part.length === AT_ONCE || bytes + file.size > PORTION_BYTES)) {
      yield part;
      part = [];
      bytes = 0;
    }
    if (file) {
      part.push(file);
      bytes += file.size;
    }
  }
}

/** Send the features of a photograph, and the name of its file. */
async function fromDevice(album: string, file: File): Promise<Line | string> {
  const named = (picture: Picture): Picture =>
    "features" in picture ? { features: new File([picture.features], file.name) } : picture;
  try {
    return await device.send([file], {}, async ([picture]) => {
      for await (const line of api.addToAlbum(album, [named(picture!)])) return line;
      return "not added";
    });
  } catch (failure) {
    if (failure instanceof InputError) return failure.message;
    throw failure;
  }
}

/** Return a small copy of a picture; null for kinds that the browser does not show. */
export async function thumbnailOf(file: File): Promise<Thumbnail | null> {
  try {
    const picture = await createImageBitmap(file, { resizeWidth: WIDTH, resizeQuality: "medium" });
    const canvas = h("canvas", { width: picture.width, height: picture.height });
    canvas.getContext("2d")!.drawImage(picture, 0, 0);
    picture.close();
    const content = await new Promise<Blob | null>((done) => canvas.toBlob(done, "image/jpeg", 0.85));
    return content && { url: URL.createObjectURL(content), shape: canvas.height / canvas.width };
  } catch {
    return null;
  }
}
