/** Parts of an API description as HTML. */

import { key } from "./api";
import { h } from "./dom";
import type { Operation, Schema } from "./openapi";

/** Descriptions are Markdown, of which they use code between backticks and nothing else. */
export function prose(tag: "p" | "span" | "td", text: string | undefined): HTMLElement {
  return h(tag, {}, ...(text ?? "").split("`").map((part, index) => (index % 2 === 1 ? h("code", {}, part) : part)));
}

function typeOf(schema: Schema | undefined): (Node | string)[] {
  if (schema === undefined) return [];
  if (schema.$ref !== undefined) {
    const name = schema.$ref.split("/").pop() ?? "";
    return [h("a", { href: `#schema-${name}` }, name)];
  }
  const options = schema.anyOf ?? schema.allOf;
  if (options !== undefined) return options.flatMap((option, index) => [index === 0 ? "" : " | ", ...typeOf(option)]);
  if (schema.enum !== undefined) return [schema.enum.map((value) => JSON.stringify(value)).join(" | ")];
  if (schema.type === "array") return ["list of ", ...typeOf(schema.items)];
  return [[schema.type, schema.format].filter(Boolean).join(", ")];
}

/** Fields with their types and meanings; those that must be there have a star. */
export function fieldTable(properties: Record<string, Schema>, required: string[]): HTMLElement {
  return h("table", {}, ...Object.entries(properties).map(([name, schema]) => h("tr", {},
    h("th", { scope: "row" }, h("code", {}, name), required.includes(name) ? " *" : ""), h("td", {}, ...typeOf(schema)),
    prose("td", schema.description))));
}

const PLAN = '{"rooms": [{"name": "kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.5}]}';
const PARTS: Record<string, string> = {
  file: "@plan.json", panorama: "@photo.jpg", floorplan_id: "$PLAN", heading_deg: "250",
};

/** How the operation is called with curl. */
export function example(method: string, path: string, described: Operation): HTMLElement {
  const parts = [`curl ${location.origin}${path.replace(/\{floorplan_id\}/g, "$PLAN").replace(/\{(\w+)\}/g, (_, name: string) => `$${name.toUpperCase()}`)}`];
  if (method !== "get") parts.push(`-X ${method.toUpperCase()}`);
  if (key.get() !== null) parts.push('-H "Authorization: Bearer $LALALOC_KEY"');
  if (method === "put") parts.push(`-H 'If-Match: "'$REVISION'"'`);
  const content = described.requestBody?.content ?? {};
  const form = content["multipart/form-data"]?.schema;
  if (content["application/json"] !== undefined) parts.push(`-H 'Content-Type: application/json' -d '${PLAN}'`);
  else if (form !== undefined) {
    const named = Object.keys(form.properties ?? {}).filter((name) => form.required?.includes(name) || name === "heading_deg");
    parts.push(...named.map((name) => `-F "${name}=${PARTS[name] ?? "…"}"`));
  }
  return h("pre", { tabindex: 0 }, parts.join(" \\\n  "));
}
