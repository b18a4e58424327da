// Runs docs.js on a page that is nothing but lists of nodes, and prints the text that is shown and the text of its code.
"use strict";

const fs = require("node:fs");
const vm = require("node:vm");

const [script, description] = process.argv.slice(2);
const made = (tag) => ({
  tag, nodes: [],
  append(...nodes) { this.nodes.push(...nodes); },
  set textContent(text) { this.nodes = [text]; },
});
const parts = { description: made("p"), operations: made("div"), schemas: made("div") };
const page = {
  document: { createElement: made, getElementById: (id) => parts[id] },
  fetch: async () => ({ json: async () => JSON.parse(fs.readFileSync(description, "utf8")) }),
};
vm.runInNewContext(fs.readFileSync(script, "utf8"), page);

const text = [], code = [];
function read(node, tag) {
  if (typeof node === "string") (tag === "code" ? code : text).push(node);
  else node.nodes.forEach((inner) => read(inner, node.tag));
}
setTimeout(() => {
  Object.values(parts).forEach((part) => read(part));
  process.stdout.write(JSON.stringify({ text, code }));
}, 100);
