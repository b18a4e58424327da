/** Plain words for the service's messages, which name the fields of its API. */

// Labels of this page by the names of fields.
const LABELS: Record<string, string> = {
  heading_deg: "Heading",
  headings_deg: "Heading",
  heading_tolerance_deg: "Heading error",
  camera_height_m: "Camera height",
  hfov_deg: "Field of view",
  pitch_deg: "Tilted up by",
  roll_deg: "Leaning right by",
  near: "Mark",
  radius_m: "Radius",
  rooms: "Rooms",
  strict: "Search only within the hints",
  level: "Level",
  units: "Unit",
  scale: "Scale on paper",
  metres_per_pixel: "Metres per pixel",
  known_distance: "Distance of the ends",
  multiply: "Factor of all lengths",
  crop: "Only this part",
  page: "Page of a PDF",
  layers: "Only these layers",
  ceiling_height_m: "Ceiling",
  plan: "A plan, though it looks like a photograph",
  north_deg: "North",
  sill_m: "From, m over the floor",
  head_m: "To, m over the floor",
  opening_kinds: "Complete in this plan",
  opening_trust: "Trust in openings",
  projection: "Kind",
  motion: "These photographs are",
};
// Words of the page for values of fields.
const VALUES: Record<string, string> = {
  cylindrical: "panorama mode of a phone",
  equirectangular: "360° photograph",
  turn: "taken from one spot, turning",
};

/** Return the label of a field, by its name in the API. */
export const labelOf = (field: string): string => LABELS[field] ?? field;

/** Return a probability; none is 0 or 100 %. */
export const percent = (share: number): string =>
  share < 0.005 ? "< 1 %" : share >= 0.995 ? "> 99 %" : `${Math.round(100 * share)} %`;

/** Replace names of fields in a message by their labels; leave out those of settings and of files of documentation. */
export function plainWords(message: string): string {
  return message
    .replace(/[;,] see docs\/\S+$/, "")
    .replace(/(?<!\/)\balbum(?=s?\b)/g, "folder")
    .replace(/photo\[(\d+)\]/g, (_, index: string) => `photo ${Number(index) + 1}`)
    .replace(/\b(\d+)\d{5} bytes/g, (_, tenths: string) => `${Number(tenths) / 10} MB`)
    .replace(/ \((?:LALALOC_[A-Z_]+|([a-z]+(?:_[a-z]+)+))\)/g, (whole, name: string) => (name in LABELS ? whole : ""))
    .replace(/\b([a-z]+)=(\w+(?:[.,:]\d+)*)/g, (whole, field: string, value: string) =>
      field in LABELS ? `“${labelOf(field)}” (${VALUES[value] ?? value})` : whole,
    )
    .replace(/`?\b([a-z]+(?:_[a-z]+)+)\b`?/g, (whole, field: string) =>
      field in LABELS ? `“${labelOf(field)}”` : whole,
    )
    .replace(/`([a-z]+)`/g, (whole, field: string) => (field in LABELS ? `“${labelOf(field)}”` : whole));
}

/** Return a message in the words of the page of folders, which has no fields for photographs. */
export const folderWords = (message: string): string =>
  plainWords(message).replace("state “Field of view”, or ", "").replace("state “", "on the start page state “");
