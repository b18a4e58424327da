/** Strokes of the layout's lines over a picture. */

import { h } from "./dom";
import type { LayoutLine } from "./layout";
import type { Point } from "./types";

// Dashes tell lines apart as well as colours, which are in the style sheet.
const STROKES: Record<LayoutLine["kind"], { variable: string; dash: number[]; name: string }> = {
  edge: { variable: "--over-wall", dash: [], name: "walls" },
  door: { variable: "--over-door", dash: [10, 4], name: "doors" },
  window: { variable: "--over-window", dash: [3, 3], name: "windows" },
  passage: { variable: "--over-passage", dash: [12, 4, 3, 4], name: "passages" },
};

/** Line of the layout in the pieces that the picture shows. */
export interface SeenLine {
  kind: LayoutLine["kind"];
  pieces: Point[][];
}

/** Stroke lines on a canvas, `scale` times as thick as on the screen. */
export function strokeLines(context: CanvasRenderingContext2D, lines: SeenLine[], scale = 1): void {
  context.lineJoin = context.lineCap = "round";
  const style = getComputedStyle(document.documentElement);
  for (const halo of [true, false]) {
    for (const { kind, pieces } of lines) {
      const { variable, dash } = STROKES[kind];
      context.strokeStyle = halo ? "rgba(0, 0, 0, 0.55)" : style.getPropertyValue(variable).trim();
      context.lineWidth = scale * (halo ? 5 : 2.5);
      context.setLineDash(halo ? [] : dash.map((length) => scale * length));
      for (const piece of pieces) {
        context.beginPath();
        piece.forEach(([x, y], index) => (index === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
        context.stroke();
      }
    }
  }
}

export function linesLegend(): HTMLElement {
  return h(
    "ul",
    { class: "legend", "aria-label": "Lines over the photograph" },
    ...Object.entries(STROKES).map(([kind, { name }]) => h("li", {}, h("span", { class: `swatch ${kind}` }), name)),
  );
}
