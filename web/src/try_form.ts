/** A form that sends one operation, and shows what came back. */

import { Refusal, request } from "./api";
import { h, show } from "./dom";
import { showError } from "./notices";
import type { Description, Operation, Schema } from "./openapi";

const MOST_SHOWN = 20_000;
let number = 0;

/** The form of an operation; files, fields, parameters and JSON bodies as it has them. */
export function tryForm(api: Description, method: string, path: string, described: Operation): HTMLElement {
  const id = `try-${++number}`;
  const content = described.requestBody?.content ?? {};
  const form = content["multipart/form-data"]?.schema, json = content["application/json"]?.schema;
  const field = (name: string, input: HTMLElement, required: boolean): HTMLElement => {
    input.id = `${id}-${name}`;
    input.setAttribute("name", name);
    if (required) input.setAttribute("required", "");
    return h("div", { class: "field" }, h("label", { for: input.id }, name + (required ? " *" : "")), input);
  };
  const parameters = (described.parameters ?? []).map((parameter) =>
    ({ parameter, input: inputOf(parameter.schema) }));
  const parts = json === undefined ? Object.entries(form?.properties ?? {}).map(([name, schema]) =>
    ({ name, input: inputOf(schema), required: form?.required?.includes(name) ?? false })) : [];
  const body = json === undefined ? null : h("textarea", { rows: 10, spellcheck: "false" });
  if (body !== null) body.value = JSON.stringify(resolve(api, json)?.example ?? {}, null, 1);
  const error = h("div", { class: "error", role: "alert", id: `${id}-error`, hidden: true });
  const result = h("div", { role: "status" });
  const element = h("form", { class: "try" }, h("h3", {}, "Try it"),
    ...parameters.map(({ parameter, input }) => field(parameter.name, input, parameter.in === "path")),
    ...parts.map(({ name, input, required }) => field(name, input, required)),
    body && field("body", body, true),
    h("div", { class: "ask" }, h("button", { class: "primary" }, "Send")), error, result);

  element.addEventListener("submit", async (event) => {
    event.preventDefault();
    show(result, "…");
    error.hidden = true;
    const begin = performance.now();
    try {
      const { url, headers } = addressed(path, parameters);
      const options: RequestInit = { method: method.toUpperCase(), headers };
      if (body !== null) {
        headers.set("Content-Type", "application/json");
        options.body = body.value;
      } else if (parts.length > 0) options.body = multipart(parts);
      const response = await request(url, options);
      show(result, await shown(response, performance.now() - begin));
    } catch (failure) {
      show(result, failure instanceof Refusal ? h("p", { class: "hint" }, `Status ${failure.status}`) : "");
      showError(error, failure);
    }
  });
  return element;
}

function resolve(api: Description, schema: Schema | undefined): Schema | undefined {
  return schema?.$ref === undefined ? schema : api.components.schemas[schema.$ref.split("/").pop() ?? ""];
}

function inputOf(schema: Schema | undefined): HTMLInputElement | HTMLSelectElement {
  const plain = schema?.anyOf?.find((option) => option.type !== "null") ?? schema;
  if (plain?.format === "binary") return h("input", { type: "file" });
  if (plain?.enum !== undefined) return h("select", {}, h("option", { value: "" }, ""), ...plain.enum.map((value) => h("option", {}, String(value))));
  const isNumber = plain?.type === "number" || plain?.type === "integer";
  return h("input", { type: isNumber ? "number" : "text", step: "any", placeholder: schema?.default === undefined ? null : String(schema.default) });
}

type Asked = { parameter: NonNullable<Operation["parameters"]>[number]; input: HTMLInputElement | HTMLSelectElement }[];

function addressed(path: string, parameters: Asked): { url: string; headers: Headers } {
  const headers = new Headers(), query = new URLSearchParams();
  let url = path;
  for (const { parameter, input } of parameters) {
    const value = input.value.trim();
    if (parameter.in === "path") url = url.replace(`{${parameter.name}}`, encodeURIComponent(value));
    else if (value === "") continue;
    else if (parameter.in === "header") headers.set(parameter.name, value);
    else for (const one of parameter.schema?.anyOf?.some(({ type }) => type === "array") ? value.split(/[\s,]+/) : [value]) query.append(parameter.name, one);
  }
  return { url: query.size > 0 ? `${url}?${query}` : url, headers };
}

function multipart(parts: { name: string; input: HTMLInputElement | HTMLSelectElement }[]): FormData {
  const data = new FormData();
  for (const { name, input } of parts) {
    const files = input instanceof HTMLInputElement ? input.files : null;
    if (files !== null) for (const file of files) data.append(name, file);
    else if (input.value.trim() !== "") data.append(name, input.value);
  }
  return data;
}

async function shown(response: Response, spentMs: number): Promise<HTMLElement> {
  const type = response.headers.get("content-type") ?? "";
  const head = h("p", { class: "hint" }, `Status ${response.status}, ${type || "no content"}, ${Math.round(spentMs)} ms`);
  if (type.startsWith("image/")) {
    // A picture is shown as one: whatever is in it runs nowhere.
    const url = URL.createObjectURL(await response.blob());
    return h("div", {}, head, h("img", { src: url, alt: "The picture that came back" }));
  }
  if (/json|text/.test(type)) {
    const text = await response.text();
    const pretty = type.includes("json") ? JSON.stringify(JSON.parse(text), null, 1) : text;
    const cut = pretty.length > MOST_SHOWN ? `${pretty.slice(0, MOST_SHOWN)}\n… ${pretty.length} characters in all` : pretty;
    return h("div", {}, head, h("pre", { tabindex: 0 }, cut));
  }
  return h("div", {}, head, `${(await response.arrayBuffer()).byteLength} bytes`);
}
