/** Code for the same query: curl and Python. */

import { key } from "./api";
import { splitFields } from "./device/device";
import type { Photo } from "./photos";

const shell = (text: string): string => (/^[\w@./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
const python = (text: string): string => JSON.stringify(text);

/** Return a field's value as a Python literal; objects and lists of strings look the same in JSON. */
function literal(name: string, value: string): string {
  if (value === "true") return "True";
  if (name === "headings_deg") return value.replaceAll("null", "None");
  return name === "near" || name === "rooms" || /^-?[\d.]+$/.test(value) ? value : python(value);
}

/** Latest query about a photograph, with the names of its files. */
export type Asked = Omit<Photo["asked"], "files"> & { files: string[] };

/** Return the query as a curl command, after the command that computes the features if these are sent. */
export function curlSnippet({ fields: all, files, onDevice }: Asked): string {
  const { query, stated } = splitFields(all),
    fields = onDevice ? query : all;
  const camera = Object.entries(stated)
    .map(([name, value]) => ` --${name.replace(/_deg$/, "")} ${shell(value)}`)
    .join("");
  const encode = onDevice ? `lalaloc encode${files.map((file) => ` ${shell(file)}`).join("")}${camera}\n` : "";
  const parts = [`curl ${shell(`${location.origin}/localise${fields.motion === undefined ? "" : "/sequence"}`)}`];
  if (key.get() !== null) parts.push(`-H "Authorization: Bearer $LALALOC_KEY"`);
  for (const [name, value] of Object.entries(fields)) parts.push(`-F ${shell(`${name}=${value}`)}`);
  for (const file of files)
    parts.push(`-F ${shell(onDevice ? `features=@${file.replace(/\.[^.]*$/, "")}.features` : `photo=@${file}`)}`);
  return encode + parts.join(" \\\n  ");
}

/** Return the query as Python code. */
export function pythonSnippet({ fields, files, onDevice }: Asked): string {
  const { floorplan_id: plan, venue_id: venue, ...rest } = fields;
  const isGroup = fields.motion !== undefined;
  const options = Object.entries(isGroup && venue !== undefined ? { venue_id: venue, ...rest } : rest)
    .filter(([name]) => name !== "include")
    .map(([name, value]) => `, ${name}=${literal(name, value)}`);
  if (onDevice) options.push(", on_device=True");
  const method = isGroup ? "localise_sequence" : venue === undefined ? "localise" : "localise_in_venue";
  const place = plan ?? (isGroup ? undefined : venue);
  const photos = isGroup ? `[${files.map(python).join(", ")}]` : python(files[0] ?? "");
  const secret = key.get() === null ? "" : `, api_key=os.environ["LALALOC_KEY"]`;
  return [
    ...(secret ? ["import os", ""] : []),
    "from lalaloc_client import Client",
    "",
    `with Client(${python(location.origin)}${secret}) as service:`,
    `    answer = service.${method}(${place === undefined ? "None" : python(place)}, ${photos}${options.join("")})`,
    isGroup
      ? "print(answer.confidence, [(pose.room, pose.position) for pose in answer.poses])"
      : "print(answer.room, answer.position, answer.confidence)",
  ].join("\n");
}
