/** Code for the same query: curl and Python. */

import { key } from "./api";

const shell = (text: string): string => (/^[\w@./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
const python = (text: string): string => JSON.stringify(text);

/** Return a field's value as a Python literal; objects and lists look the same in JSON. */
function literal(name: string, value: string): string {
  if (value === "true") return "True";
  return name === "near" || name === "rooms" || /^-?[\d.]+$/.test(value) ? value : python(value);
}

/** Return the query as a curl command. */
export function curlSnippet(fields: Record<string, string>, file: string): string {
  const parts = [`curl ${shell(`${location.origin}/localise`)}`];
  if (key.get() !== null) parts.push(`-H "Authorization: Bearer $LALALOC_KEY"`);
  for (const [name, value] of Object.entries(fields)) parts.push(`-F ${shell(`${name}=${value}`)}`);
  parts.push(`-F ${shell(`panorama=@${file}`)}`);
  return parts.join(" \\\n  ");
}

/** Return the query as Python code. */
export function pythonSnippet(fields: Record<string, string>, file: string): string {
  const { floorplan_id: plan, venue_id: venue, ...rest } = fields;
  const options = Object.entries(rest)
    .filter(([name]) => name !== "include")
    .map(([name, value]) => `, ${name}=${literal(name, value)}`);
  const ask = venue === undefined ? `localise(${python(plan ?? "")}` : `localise_in_venue(${python(venue)}`;
  const secret = key.get() === null ? "" : `, api_key=os.environ["LALALOC_KEY"]`;
  return [
    ...(secret ? ["import os", ""] : []),
    "from lalaloc_client import Client",
    "",
    `with Client(${python(location.origin)}${secret}) as service:`,
    `    answer = service.${ask}, ${python(file)}${options.join("")})`,
    "print(answer.room, answer.position, answer.confidence)",
  ].join("\n");
}
