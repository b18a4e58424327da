/** Pictures to save: the map as it is shown, and the answer to a photograph. */

import { api } from "./api";
import { device } from "./device/device";
import { byId, download } from "./dom";
import { clearError, InputError, showError } from "./notices";
import type { Photo } from "./photos";

// Pixels of the longer side, and properties that style sheets set.
const PIXELS = 2400;
const STYLES = [
  "display",
  "fill",
  "fill-opacity",
  "font-family",
  "font-size",
  "font-weight",
  "opacity",
  "paint-order",
  "stroke",
  "stroke-dasharray",
  "stroke-linecap",
  "stroke-linejoin",
  "stroke-opacity",
  "stroke-width",
  "text-anchor",
  "vector-effect",
  "visibility",
];

/** Save the map with a click on its button; `name` returns the name of the plan. */
export function connectSaveMap(map: SVGSVGElement, name: () => string): void {
  byId("save-map").addEventListener("click", () => {
    clearError(byId("plan-error"));
    saveMap(map, name()).catch((error: unknown) => showError(byId("plan-error"), error));
  });
}

/** Save the answer to a photograph, drawn by the service. */
export async function savePicture(photo: Photo, fields: Record<string, HTMLElement>): Promise<void> {
  clearError(byId("photo-error"), fields);
  try {
    const picture = await device.send([photo.file], photo.asked.fields, ([sent], own) => api.picture(own, sent!));
    download(picture, `lalaloc-${photo.file.name.replace(/\.[^.]*$/, "")}.png`);
  } catch (error) {
    showError(byId("photo-error"), error, fields);
  }
}

/** Save the visible part of the map as PNG. */
async function saveMap(map: SVGSVGElement, name: string): Promise<void> {
  const { width, height } = map.getBoundingClientRect(),
    scale = PIXELS / Math.max(width, height);
  const picture = new Image();
  picture.src = URL.createObjectURL(new Blob([standalone(map, scale)], { type: "image/svg+xml" }));
  try {
    await picture.decode();
  } catch {
    throw new InputError("The browser cannot draw the map as a picture.");
  } finally {
    URL.revokeObjectURL(picture.src);
  }
  const canvas = document.createElement("canvas");
  canvas.width = Math.round(scale * width);
  canvas.height = Math.round(scale * height);
  const context = canvas.getContext("2d")!;
  context.fillStyle = getComputedStyle(map.parentElement!).backgroundColor;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  const content = await new Promise<Blob | null>((done) => canvas.toBlob(done));
  if (content === null) throw new InputError("The browser cannot save the map as a picture.");
  download(content, `${name.replace(/[^\p{L}\p{N} _-]/gu, "").trim() || "plan"}.png`);
}

/** Return the map as SVG that needs no style sheet, larger than on the screen by `scale`. */
function standalone(map: SVGSVGElement, scale: number): string {
  const { width, height } = map.getBoundingClientRect();
  const copy = map.cloneNode(true) as SVGSVGElement;
  const shown = map.querySelectorAll("*"),
    copied = copy.querySelectorAll<SVGElement>("*");
  shown.forEach((element, index) => {
    const computed = getComputedStyle(element),
      style = copied[index]!.style;
    for (const property of STYLES) style.setProperty(property, computed.getPropertyValue(property));
    // Strokes in pixels of the screen.
    if (computed.vectorEffect !== "non-scaling-stroke") return;
    style.strokeWidth = `${scale * parseFloat(computed.strokeWidth)}px`;
    style.strokeDasharray = computed.strokeDasharray.replace(/[\d.]+/g, (length) => String(scale * Number(length)));
  });
  copy.setAttribute("width", String(scale * width));
  copy.setAttribute("height", String(scale * height));
  return new XMLSerializer().serializeToString(copy);
}
