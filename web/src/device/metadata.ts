/** EXIF and Photo Sphere metadata of JPEG, PNG and WebP files; unreadable metadata count as missing. */

/** Numbers by EXIF tag, and GPano properties by name. */
export interface Metadata {
  exif: Map<number, number>;
  sphere: Map<string, string>;
}

export const TAG = { width: 0xa002, height: 0xa003, customRendered: 0xa401, zoom: 0xa404, film: 0xa405 } as const;
const EXIF_IFD = 0x8769;
const MAX_ENTRIES = 500;
const XMP_HEAD = "http://ns.adobe.com/xap/1.0/\0",
  EXIF_HEAD = "Exif\0\0",
  PNG_XMP = "XML:com.adobe.xmp\0";

/** Read the metadata of a file. */
export function readMetadata(content: ArrayBuffer): Metadata {
  const view = new DataView(content),
    found: Metadata = { exif: new Map(), sphere: new Map() };
  try {
    if (view.getUint16(0) === 0xffd8) jpegParts(view, found);
    else if (ascii(view, 1, 3) === "PNG") pngParts(view, found);
    else if (ascii(view, 0, 4) === "RIFF") webpParts(view, found);
  } catch (error) {
    // Offsets beyond the end of a damaged file.
    if (!(error instanceof RangeError)) throw error;
  }
  return found;
}

function ascii(view: DataView, from: number, length: number): string {
  return String.fromCharCode(...new Uint8Array(view.buffer, from, length));
}

function jpegParts(view: DataView, found: Metadata): void {
  for (let at = 2; view.getUint8(at) === 0xff;) {
    const marker = view.getUint8(at + 1),
      length = view.getUint16(at + 2),
      begin = at + 4;
    if (marker === 0xda) return;
    if (marker === 0xe1 && ascii(view, begin, EXIF_HEAD.length) === EXIF_HEAD)
      readTiff(view, begin + EXIF_HEAD.length, found);
    else if (marker === 0xe1 && ascii(view, begin, Math.min(XMP_HEAD.length, length - 2)) === XMP_HEAD)
      readXmp(text(view, begin + XMP_HEAD.length, at + 2 + length), found);
    at += 2 + length;
  }
}

function pngParts(view: DataView, found: Metadata): void {
  for (let at = 8; at + 8 <= view.byteLength; at += 12 + view.getUint32(at)) {
    const kind = ascii(view, at + 4, 4),
      begin = at + 8,
      end = begin + view.getUint32(at);
    if (kind === "eXIf") readTiff(view, begin, found);
    if (kind === "iTXt" && text(view, begin, Math.min(end, begin + PNG_XMP.length)) === PNG_XMP)
      readXmp(text(view, begin, end), found);
  }
}

function webpParts(view: DataView, found: Metadata): void {
  for (let at = 12; at + 8 <= view.byteLength;) {
    const kind = ascii(view, at, 4),
      length = view.getUint32(at + 4, true),
      begin = at + 8;
    if (kind === "EXIF")
      readTiff(view, ascii(view, begin, EXIF_HEAD.length) === EXIF_HEAD ? begin + EXIF_HEAD.length : begin, found);
    if (kind === "XMP ") readXmp(text(view, begin, begin + length), found);
    at = begin + length + (length % 2);
  }
}

function text(view: DataView, from: number, to: number): string {
  return new TextDecoder().decode(new Uint8Array(view.buffer, from, to - from));
}

/** Read the GPano properties of a packet, from attributes and elements; the first of each name counts. */
function readXmp(packet: string, { sphere }: Metadata): void {
  for (const [, name, attribute, element] of packet.matchAll(
    /\bGPano:(\w+)\s*(?:=\s*["']([^"'<>]*)["']|>([^<>]*)<)/g,
  )) {
    if (!sphere.has(name!)) sphere.set(name!, (attribute ?? element ?? "").trim());
  }
}

/** Read the numbers of the main directory and of the Exif directory. */
function readTiff(view: DataView, start: number, { exif }: Metadata): void {
  const little = view.getUint16(start) === 0x4949;
  const directory = (offset: number): void => {
    const count = Math.min(view.getUint16(start + offset, little), MAX_ENTRIES);
    for (let entry = 0; entry < count; entry++) {
      const at = start + offset + 2 + 12 * entry,
        tag = view.getUint16(at, little);
      const value = number(view, at, start, little);
      if (value !== null && !exif.has(tag)) exif.set(tag, value);
    }
  };
  directory(view.getUint32(start + 4, little));
  const own = exif.get(EXIF_IFD);
  if (own !== undefined) directory(own);
}

/** Return the number of an entry; null for text and lists. A fraction with a denominator of zero is NaN. */
function number(view: DataView, at: number, start: number, little: boolean): number | null {
  const kind = view.getUint16(at + 2, little);
  if (view.getUint32(at + 4, little) !== 1) return null;
  if (kind === 3) return view.getUint16(at + 8, little);
  if (kind === 4) return view.getUint32(at + 8, little);
  const place = start + view.getUint32(at + 8, little);
  if (kind === 5) return view.getUint32(place, little) / (view.getUint32(place + 4, little) || NaN);
  if (kind === 10) return view.getInt32(place, little) / (view.getInt32(place + 4, little) || NaN);
  return null;
}
