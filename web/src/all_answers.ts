/** Answers to all photographs as a table, and as files. */

import { within95 } from "./answer_overlay";
import { headingWords, percent } from "./answer_words";
import { button, byId, download, h, show } from "./dom";
import type { Photo } from "./photos";
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
  if (panel.hidden) {
    show(panel);
    return;
  }
  const heads = ["Photograph", "Room", "x, m", "y, m", "Heading", "Confidence"];
  const features = found.map(featureOf).filter((feature) => feature !== null);
  show(
    panel,
    h("h3", {}, "All photographs"),
    h(
      "div",
      { class: "table" },
      h(
        "table",
        {},
        h("thead", {}, h("tr", {}, ...heads.map((head) => h("th", { scope: "col" }, head)))),
        h(
          "tbody",
          {},
          ...found.map(({ photo, answer }) =>
            h(
              "tr",
              {},
              h(
                "th",
                { scope: "row" },
                button(nameOf(photo), () => choose(photo)),
              ),
              h("td", {}, answer.room),
              h("td", {}, answer.position.x_m.toFixed(2)),
              h("td", {}, answer.position.y_m.toFixed(2)),
              h("td", {}, headingWords(answer.heading_deg, null)),
              h("td", {}, answer.confidence === null ? "–" : percent(answer.confidence)),
            ),
          ),
        ),
      ),
    ),
    h(
      "div",
      { class: "sharing" },
      button("Save CSV", () => download(new Blob([csvOf(found)], { type: "text/csv" }), "lalaloc.csv"), {
        id: "save-csv",
      }),
      // GeoJSON needs places on Earth, which only plans with an anchor have.
      features.length === found.length
        ? button(
            "Save GeoJSON",
            () =>
              download(
                new Blob([JSON.stringify({ type: "FeatureCollection", features })], { type: "application/geo+json" }),
                "lalaloc.geojson",
              ),
            { id: "save-geojson" },
          )
        : h("p", { class: "hint" }, "GeoJSON can be saved for plans whose place on Earth is known."),
    ),
  );
}

const nameOf = (photo: Photo): string => photo.file.name.replace(/^example-/, "");

/** Quote a value of a CSV file; a leading sign of a formula would be run by spreadsheets. */
function quoted(value: string): string {
  const safe = /^[=+@\t\r]/.test(value) ? `'${value}` : value;
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
