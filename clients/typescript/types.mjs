// Generates generated/api.ts, the types of the API, from openapi.yaml.
import { mkdirSync, writeFileSync } from "node:fs";

import openapiTS, { astToString, transformSchemaObject } from "openapi-typescript";
import ts from "typescript";

const nodes = await openapiTS(new URL("../../openapi.yaml", import.meta.url), {
  defaultNonNullable: false,
  // Arrays of fixed length are tuples: points, lines, matrices.
  transform(schema, options) {
    if (schema.type !== "array" || !(schema.maxItems > 1) || schema.minItems !== schema.maxItems) return undefined;
    const items = schema.prefixItems ?? Array.from({ length: schema.maxItems }, () => schema.items);
    return ts.factory.createTupleTypeNode(items.map((item) => transformSchemaObject(item, options)));
  },
});
mkdirSync(new URL("generated", import.meta.url), { recursive: true });
writeFileSync(new URL("generated/api.ts", import.meta.url), astToString(nodes));
