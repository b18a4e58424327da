/** The same question for a terminal and for a program. */

import { key } from "./api";

const shell = (text: string): string => (/^[\w@./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
const python = (text: string): string => JSON.stringify(text);

/** The query with curl. */
export function curlSnippet(fields: Record<string, string>, file: string): string {
  const parts = [`curl ${shell(`${location.origin}/localise`)}`];
  if (key.get() !== null) parts.push(`-H "Authorization: Bearer $LALALOC_KEY"`);
  for (const [name, value] of Object.entries(fields)) parts.push(`-F ${shell(`${name}=${value}`)}`);
  parts.push(`-F ${shell(`panorama=@${file}`)}`);
  return parts.join(" \\\n  ");
}

/** The query with the Python client. */
export function pythonSnippet(fields: Record<string, string>, file: string): string {
  const { floorplan_id: plan = "", ...rest } = fields;
  const options = Object.entries(rest)
    .filter(([name]) => name !== "include")
    .map(([name, value]) => `, ${name}=${/^-?[\d.]+$/.test(value) ? value : python(value)}`);
  const secret = key.get() === null ? "" : `, api_key=os.environ["LALALOC_KEY"]`;
  return [
    ...(secret ? ["import os", ""] : []),
    "from lalaloc_client import Client",
    "",
    `with Client(${python(location.origin)}${secret}) as service:`,
    `    answer = service.localise(${python(plan)}, ${python(file)}${options.join("")})`,
    "print(answer.room, answer.position, answer.confidence)",
  ].join("\n");
}
