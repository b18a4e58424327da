"""The TypeScript client: its package compiles, and the example of its README works in Node."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import jpeg, sphere, take
from tests.service.conftest import StartApp

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "clients" / "typescript"
_RUN = """
import { readFileSync } from "node:fs";
import { Client } from "lalaloc-client";
import { findHeading, findRooms } from "./example.js";

const [plan, photo] = process.argv.slice(2).map((path) => new Blob([readFileSync(path)]));
console.log(JSON.stringify(await findRooms(plan, [photo, plan])));
const { floorplans } = await (await fetch("ADDRESS/floorplans")).json();
console.log(await findHeading(floorplans[0].id, photo, AbortSignal.timeout(60000)));
console.log(await findHeading(floorplans[0].id, plan, AbortSignal.timeout(60000)));
console.log(await findHeading("f".repeat(32), photo, AbortSignal.timeout(60000)).catch((error) => error.slug));
const service = new Client({ baseUrl: "ADDRESS" });
const fields = { floorplan_id: floorplans[0].id, hfov_deg: 53, refine: "none" };
const frames = process.argv.slice(4).map((path) => new Blob([readFileSync(path)]));
for (const headings of [[0, 40], [null, null]]) {
  const turn = frames.map((picture, index) => ({ picture, headingDeg: headings[index] }));
  const { poses } = await service.localiseTurn(fields, turn);
  console.log(JSON.stringify(poses.map(({ view }) => view.relative_heading)));
}
"""


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("node") is None or not (PACKAGE / "node_modules").is_dir(),
    reason="needs Node, and `npm ci` in clients/typescript",
)
def test_readme_example_works_in_node(start_app: StartApp, tmp_path: Path) -> None:
    def tsc(*arguments: str, cwd: Path) -> None:
        done = subprocess.run(
            ["node", str(PACKAGE / "node_modules/typescript/bin/tsc"), *arguments],
            cwd=cwd,
            stdout=subprocess.PIPE,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout

    subprocess.run(["node", "types.mjs"], cwd=PACKAGE, check=True, timeout=300)
    installed = tmp_path / "node_modules" / "lalaloc-client"
    tsc("--outDir", str(installed / "dist"), cwd=PACKAGE)
    shutil.copy(PACKAGE / "package.json", installed)
    (example,) = re.findall(r"```ts\n(.*?)```", (PACKAGE / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    with start_app(tmp_path / "data") as app:
        address = str(app.base_url).rstrip("/")
        (tmp_path / "example.ts").write_text(example.replace("http://127.0.0.1:8000", address))
        (tmp_path / "package.json").write_text('{"type": "module"}')
        (tmp_path / "run.js").write_text(_RUN.replace("ADDRESS", address))
        strict = ["--strict", "--target", "ES2022", "--module", "nodenext", "--lib", "ES2022,DOM,DOM.Iterable"]
        tsc(*strict, "example.ts", cwd=tmp_path)
        files = [str(ROOT / "examples" / name) for name in ("flat.json", "study.jpg")]
        camera = Perspective.of_hfov(360, 480, math.radians(53.0))
        for heading_deg in (0.0, 40.0):
            files.append(str(tmp_path / f"{heading_deg:g}.jpg"))
            Path(files[-1]).write_bytes(jpeg(take(sphere("study"), camera, heading_deg=heading_deg)))
        done = subprocess.run(
            ["node", "run.js", *files], cwd=tmp_path, stdout=subprocess.PIPE, text=True, timeout=300, check=True
        )
    rooms, heading, unread, unknown, given, overlap = done.stdout.splitlines()
    assert re.fullmatch(r'\["(bedroom|study)","not localised: .*"\]', rooms, re.IGNORECASE), rooms
    assert 0.0 <= float(heading) < 360.0
    assert (unread, unknown) == ("null", "unknown-floorplan")
    assert [(angle["value_deg"], angle["source"]) for angle in json.loads(given)] == [(0, "given"), (40, "given")]
    first, second = json.loads(overlap)
    assert (first["source"], second["source"]) == ("estimated", "estimated")
    assert second["value_deg"] == pytest.approx(40.0, abs=2.0)
