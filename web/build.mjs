// Builds the web pages into service/web, with the digest of their sources.
import { createHash } from "node:crypto";
import { copyFileSync, mkdirSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { basename, dirname, join, relative, sep } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const root = dirname(here);
const out = join(root, "service", "web");
const examples = [
  "flat.json",
  "turn_1.jpg",
  "turn_2.jpg",
  "turn_3.jpg",
  "turn_4.jpg",
  "living_room.jpg",
  "kitchen.jpg",
  "bedroom.jpg",
  "study.jpg",
  "real/rooms.json",
  "real/lythwood_room.jpg",
];

function files(folder) {
  return readdirSync(folder, { recursive: true, withFileTypes: true })
    .filter((entry) => entry.isFile())
    .map((entry) => join(entry.parentPath ?? entry.path, entry.name));
}

function digest(path) {
  return createHash("sha256").update(readFileSync(path)).digest("hex");
}

// Sorted by name, so that renaming a file changes the digest; with slashes on every system.
const client = join(root, "clients", "typescript", "src");
const sources = [
  ...files(join(here, "src")),
  ...files(client),
  ...["build.mjs", "package.json", "package-lock.json", "tsconfig.json"].map((name) => join(here, name)),
]
  .map((path) => relative(root, path).split(sep).join("/"))
  .sort();
const sum = createHash("sha256");
for (const name of sources) sum.update(`${name}\n${digest(join(root, name))}\n`);

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
await build({
  absWorkingDir: here,
  entryPoints: [
    ...["app.ts", "pin.ts", "sphere.ts", "docs.ts", "style.css", "docs.css"].map((name) => ({
      in: `src/${name}`,
      out: name.replace(/\..*/, ""),
    })),
    { in: join(client, "index.ts"), out: "client" },
    { in: "src/device/worker.ts", out: "on_device" },
  ],
  outdir: out,
  bundle: true,
  minify: true,
  splitting: true,
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "none",
  chunkNames: "[name]-[hash]",
  logLevel: "warning",
});
for (const name of ["index.html", "pin.html", "docs.html", "pin.css", "icon.svg"])
  copyFileSync(join(here, "src", name), join(out, name));
for (const name of ["swagger-ui-bundle.js", "swagger-ui-bundle.js.LICENSE.txt", "swagger-ui.css"]) {
  copyFileSync(join(here, "node_modules", "swagger-ui-dist", name), join(out, name));
}
// The smallest build of the runtime, packed to a quarter of its size; the worker unpacks it.
const runtime = join(here, "node_modules", "onnxruntime-web", "dist", "ort-wasm-simd-threaded");
copyFileSync(`${runtime}.mjs`, join(out, "onnxruntime.js"));
writeFileSync(join(out, "onnxruntime.wasm.gz"), gzipSync(readFileSync(`${runtime}.wasm`), { level: 9 }));
for (const name of examples) copyFileSync(join(root, "examples", name), join(out, `example-${basename(name)}`));
const built = readdirSync(out).sort();
const digests = Object.fromEntries(built.map((name) => [name, digest(join(out, name))]));
writeFileSync(join(out, "built.json"), JSON.stringify({ sources: sum.digest("hex"), files: digests }, null, 1) + "\n");
