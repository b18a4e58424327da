/** Pictures: loaded from files, and saved, the map as it is shown, and an answer with its photograph. */

import { byId, download, h } from "./dom";
import { attempt, InputError } from "./notices";

// Pixels of the longer side, and properties that style sheets set.
const PIXELS = 2400;
const STYLES = (
  "display fill fill-opacity font-family font-size font-weight opacity paint-order stroke " +
  "stroke-dasharray stroke-linecap stroke-linejoin stroke-opacity stroke-width text-anchor vector-effect visibility"
).split(" ");

/** Load a picture, whose address is to be revoked after use. Rejects with a message if the browser cannot show the file. */
export async function loadPicture(file: Blob, message: string): Promise<HTMLImageElement> {
  const picture = new Image();
  picture.src = URL.createObjectURL(file);
  try {
    await picture.decode();
  } catch {
    URL.revokeObjectURL(picture.src);
    throw new InputError(message);
  }
  return picture;
}

/** Save the map with a click on its button; `name` returns the name of the plan. */
export function connectSaveMap(map: SVGSVGElement, name: () => string): void {
  byId("save-map").addEventListener("click", () => void attempt(byId("plan-error"), () => saveMap(map, name())));
}

/** Save an answer as the page shows it: the photograph with the layout, null without one, the map, and a caption. */
export async function savePicture(
  fileName: string,
  photo: HTMLCanvasElement | null,
  map: SVGSVGElement,
  caption: string[],
): Promise<void> {
  const below = await mapCanvas(map, PIXELS / 2),
    width = Math.max(photo?.width ?? 0, below.width);
  const parts = photo === null ? [below] : [photo, below];
  const heights = parts.map((part) => Math.round((part.height * width) / part.width));
  const line = Math.round(width / 40);
  const height = heights.reduce((sum, own) => sum + own, 0) + Math.round((caption.length + 0.6) * 1.4 * line);
  const canvas = h("canvas", { width, height });
  const context = canvas.getContext("2d")!,
    { color, fontFamily } = getComputedStyle(document.documentElement);
  context.fillStyle = getComputedStyle(map.parentElement!).backgroundColor;
  context.fillRect(0, 0, canvas.width, canvas.height);
  let y = 0;
  parts.forEach((part, index) => {
    context.drawImage(part, 0, y, width, heights[index]!);
    y += heights[index]!;
  });
  context.fillStyle = color;
  context.font = `${line}px ${fontFamily}`;
  caption.forEach((text, index) => context.fillText(text, line, y + 1.4 * line * (index + 1), width - 2 * line));
  await save(canvas, `lalaloc-${fileName.replace(/\.[^.]*$/, "")}.png`);
}

/** Save the visible part of the map as PNG. */
async function saveMap(map: SVGSVGElement, name: string): Promise<void> {
  await save(await mapCanvas(map, PIXELS), `${name.replace(/[^\p{L}\p{N} _-]/gu, "").trim() || "plan"}.png`);
}

/** Draw the visible part of the map, `pixels` at its longer side. */
async function mapCanvas(map: SVGSVGElement, pixels: number): Promise<HTMLCanvasElement> {
  const { width, height } = map.getBoundingClientRect(),
    scale = pixels / Math.max(width, height);
  const file = new Blob([standalone(map, scale)], { type: "image/svg+xml" });
  const picture = await loadPicture(file, "The browser cannot draw the map as a picture.");
  URL.revokeObjectURL(picture.src);
  const canvas = h("canvas", { width: Math.round(scale * width), height: Math.round(scale * height) });
  const context = canvas.getContext("2d")!;
  context.fillStyle = getComputedStyle(map.parentElement!).backgroundColor;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  return canvas;
}

async function save(canvas: HTMLCanvasElement, name: string): Promise<void> {
  const content = await new Promise<Blob | null>((done) => canvas.toBlob(done));
  if (content === null) throw new InputError("The browser cannot save this as a picture.");
  download(content, name);
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
