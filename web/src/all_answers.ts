/** Answers to all photographs as a table, and as files. */

import { within95 } from "./answer_overlay";
import { headingWords } from "./answer_words";
import { button, byId, download, h, show } from "./dom";
import type { Photo } from "./photos";
import { percent } from "./plain_words";
import type { Answer } from "./types";

interface Found {
  photo: Photo;
  answer: Answer;
}

/** Show the answers of all photographs if there are several; a click on one calls `choose`. */
export function showAll(photos: readonly Photo[], choose: (photo: Photo) => void): void {
  const found = photos.flatMap((photo): Found[] => (photo.answer === null ? [] : [{ photo, answer: photo.answer }]));
  const panel = byId("all-answers");
  panel.hidden = found.length < 2;
  if (panel.hidden) return show(panel);
  const heads = ["Photograph", "Room", "x, m", "y, m", "Heading", "Confidence"].map((head) =>
    h("th", { scope: "col" }, head),
  );
  const rows = found.map(({ photo, answer: { room, position, heading_deg, confidence } }) => {
    const name = button(nameOf(photo), () => choose(photo)),
      place = [position.x_m.toFixed(2), position.y_m.toFixed(2)];
    const words = [room, ...place, headingWords(heading_deg, null), confidence === null ? "–" : percent(confidence)];
    return h("tr", {}, h("th", { scope: "row" }, name), ...words.map((text) => h("td", {}, text)));
  });
  const features = found.map(featureOf).filter((feature) => feature !== null);
  const save = (kind: string, type: string, content: string): HTMLElement => {
    const ending = kind.toLowerCase();
    const act = (): void => download(new Blob([content], { type }), `lalaloc.${ending}`);
    return button(`Save ${kind}`, act, { id: `save-${ending}` });
  };
  show(
    panel,
    h("h3", {}, "All photographs"),
    h("div", { class: "table" }, h("table", {}, h("thead", {}, h("tr", {}, ...heads)), h("tbody", {}, ...rows))),
    h(
      "div",
      { class: "sharing" },
      save("CSV", "text/csv", csvOf(found)),
      // GeoJSON needs places on Earth, which only plans with an anchor have.
      features.length === found.length
        ? save("GeoJSON", "application/geo+json", JSON.stringify({ type: "FeatureCollection", features }))
        : h("p", { class: "hint" }, "GeoJSON needs the plan’s place on Earth: “Edit”, then “Place on Earth”."),
    ),
  );
}

const nameOf = (photo: Photo): string => photo.file.name.replace(/^example-/, "");

/** Quote a value of a CSV file, which spreadsheets do not take for a formula, as in lalaloc_core/shown_text.py. */
export function quoted(value: string): string {
  const safe = value.replace(/(^|[;\t])(?=[\s\ufeff\u200b]*[-=+@＝＋－＠﹦﹢﹣﹫])|^(?=[\t\r])/g, "$1'");
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

function csvOf(found: Found[]): string {
  const rows = found.map(({ photo, answer }) => [
    quoted(nameOf(photo)),
    answer.floorplan_id,
    quoted(answer.room),
    answer.position.x_m.toFixed(3),
    answer.position.y_m.toFixed(3),
    answer.heading_deg.toFixed(1),
    answer.covariance_m2 === null ? "" : within95(answer.covariance_m2)[0].toFixed(3),
    answer.confidence === null ? "" : answer.confidence.toFixed(4),
  ]);
  return [["photograph", "floorplan_id", "room", "x_m", "y_m", "heading_deg", "within_95_m", "confidence"], ...rows]
    .map((row) => `${row.join(",")}\r\n`)
    .join("");
}

function featureOf({ photo, answer }: Found): object | null {
  const earth = answer.geopose?.position;
  if (earth === undefined) return null;
  const { room, confidence, floorplan_id, heading_deg } = answer;
  return {
    type: "Feature",
    geometry: { type: "Point", coordinates: [earth.lon, earth.lat] },
    properties: { photograph: nameOf(photo), room, confidence, floorplan_id, heading_deg },
  };
}
