"use strict";

function node(tag, text, ...children) {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}

// Descriptions are Markdown, of which they use code between backticks and nothing else.
function prose(tag, text) {
  const made = document.createElement(tag);
  (text || "").split("`").forEach((part, index) => { if (part) made.append(index % 2 ? node("code", part) : part); });
  return made;
}

function typeOf(schema) {
  if (!schema) return "";
  if (schema.$ref) return schema.$ref.split("/").pop();
  if (schema.anyOf) return schema.anyOf.map(typeOf).join(" | ");
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (schema.type === "array") return `list of ${typeOf(schema.items)}`;
  return [schema.type, schema.format].filter(Boolean).join(", ");
}

function fields(properties, required) {
  const rows = Object.entries(properties).map(([name, schema]) => node("tr", "",
    node("td", name + (required.includes(name) ? " *" : "")), node("td", typeOf(schema)),
    prose("td", schema.description)));
  return node("table", "", ...rows);
}

function operation(method, path, described) {
  const details = node("details");
  const summary = node("summary");
  const verb = node("span", method.toUpperCase());
  verb.className = "method";
  summary.append(verb, `${path}  ${described.summary || ""}`);
  details.append(summary, prose("p", described.description));
  const parameters = described.parameters || [];
  if (parameters.length) {
    const properties = Object.fromEntries(parameters.map((parameter) =>
      [parameter.name, { ...parameter.schema, description: parameter.description }]));
    details.append(fields(properties, parameters.filter((parameter) => parameter.required).map((p) => p.name)));
  }
  for (const [media, { schema }] of Object.entries(described.requestBody?.content || {})) {
    details.append(node("p", `Body: ${media} ${typeOf(schema)}`));
    if (schema.properties) details.append(fields(schema.properties, schema.required || []));
  }
  const answers = Object.entries(described.responses).map(([status, answer]) => {
    const media = Object.entries(answer.content || {}).map(([name, { schema }]) => `${name} ${typeOf(schema)}`);
    return node("tr", "", node("td", status), prose("td", answer.description), node("td", media.join(", ")));
  });
  details.append(node("p", "Answers:"), node("table", "", ...answers));
  return details;
}

async function show() {
  const api = await (await fetch("/openapi.json")).json();
  document.getElementById("description").append(prose("span", api.info.description));
  for (const [path, methods] of Object.entries(api.paths)) {
    for (const [method, described] of Object.entries(methods)) {
      document.getElementById("operations").append(operation(method, path, described));
    }
  }
  for (const [name, schema] of Object.entries(api.components.schemas)) {
    document.getElementById("schemas").append(node("details", "", node("summary", name),
      prose("p", schema.description), fields(schema.properties || {}, schema.required || [])));
  }
}

show();
