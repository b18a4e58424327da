/** The page at /docs: every operation of the API with an example, and a form that tries it. */

import { request } from "./api";
import { byId, h, show } from "./dom";
import { connectKeyDialog } from "./key_dialog";
import { showError } from "./notices";
import type { Description, Operation, Schema } from "./openapi";
import { example, fieldTable, prose } from "./openapi_shown";
import { tryForm } from "./try_form";

function operation(api: Description, method: string, path: string, described: Operation): HTMLElement {
  const details = h("details", { class: "operation" });
  const tags = described.security?.flatMap((scheme) => Object.values(scheme).flat()) ?? [];
  details.append(h("summary", {}, h("span", { class: `method ${method}` }, method.toUpperCase()), h("code", {}, path),
    h("span", { class: "hint" }, described.summary ?? "")));
  // What is inside is made when it is looked at: there are many operations.
  details.addEventListener("toggle", () => {
    if (details.childElementCount > 1) return;
    details.append(prose("p", described.description));
    if (tags.length > 0) details.append(h("p", { class: "hint" }, `With API keys on, needs one that may ${tags.join(", ")}.`));
    const parameters = described.parameters ?? [];
    if (parameters.length > 0) {
      const properties = Object.fromEntries(parameters.map((parameter): [string, Schema] =>
        [parameter.name, { ...parameter.schema, description: parameter.description }]));
      details.append(h("h3", {}, "Parameters"),
        fieldTable(properties, parameters.filter(({ required }) => required).map(({ name }) => name)));
    }
    for (const [media, { schema }] of Object.entries(described.requestBody?.content ?? {})) {
      details.append(h("h3", {}, "Body: ", h("code", {}, media)));
      if (schema?.properties !== undefined) details.append(fieldTable(schema.properties, schema.required ?? []));
    }
    details.append(h("h3", {}, "Example"), example(method, path, described), h("h3", {}, "Answers"), answers(described),
      tryForm(api, method, path, described));
  });
  return details;
}

function answers(described: Operation): HTMLElement {
  return h("table", {}, ...Object.entries(described.responses).map(([status, answer]) => h("tr", {},
    h("th", { scope: "row" }, status), h("td", {}, prose("span", answer.description), " ",
      h("span", { class: "hint" }, Object.keys(answer.content ?? {}).join(", "))))));
}

async function start(): Promise<void> {
  connectKeyDialog();
  try {
    const api: Description = await (await request("/openapi.json")).json();
    show(byId("description"), prose("span", api.info.description));
    const operations = Object.entries(api.paths).flatMap(([path, methods]) =>
      Object.entries(methods).map(([method, described]) => ({ method, path, described })));
    const tags = [...new Set(operations.map(({ described }) => described.tags?.[0] ?? "other"))];
    show(byId("operations"), ...tags.flatMap((tag) => [h("h2", {}, tag[0]!.toUpperCase() + tag.slice(1)), ...operations
      .filter(({ described }) => (described.tags?.[0] ?? "other") === tag)
      .map(({ method, path, described }) => operation(api, method, path, described))]));
    show(byId("schemas"), ...Object.entries(api.components.schemas).map(([name, schema]) => h("details", { id: `schema-${name}` },
      h("summary", {}, name), prose("p", schema.description), fieldTable(schema.properties ?? {}, schema.required ?? []))));
  } catch (error) {
    showError(byId("docs-error"), error);
  }
}

void start();
