"""The TypeScript client: its package compiles, and the example of its README works in Node."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lalaloc_core.bundle import default_bundle
from lalaloc_core.photograph.cameras import Perspective
from service.query.localiser import LocalLocaliser
from tests.client.test_albums import busy_for
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


_RUN_ALBUM = """
import { readFileSync } from "node:fs";
import { Client, ServiceError } from "lalaloc-client";

const [plan, kitchen, study] = process.argv.slice(2).map((path) => new Blob([readFileSync(path)]));
const service = new Client({ baseUrl: "ADDRESS" });
const { id: planId } = await service.uploadPlan(plan);
const album = await service.createAlbum({ floorplan_id: planId, name: "Visit" });
const send = async () => {
  const lines = [];
  for await (const line of service.addToAlbum(album.id, [kitchen, plan, study])) lines.push(line.status);
  return lines;
};
const solved = async () => {
  for (;;) {
    const now = await service.album(album.id);
    if (now.state !== "solving") return now;
    await new Promise((done) => setTimeout(done, 200));
  }
};
const report = { sent: await send(), again: await send(), state: (await solved()).state };
const { photographs } = await service.albumPhotographs(album.id);
report.rooms = photographs.map(({ pin }) => pin.place.room);
await service.correctPhotograph(album.id, photographs[0].id, { elsewhere: true });
await solved();
report.corrected = (await service.albumPhotographs(album.id)).photographs.map(({ pin }) => pin.state);
report.table = (await (await service.albumFile(album.id, "text/csv")).text()).trim().split("\\n").length;
await service.deleteAlbumPhotograph(album.id, photographs[0].id);
report.left = (await service.album(album.id)).photographs;
report.listed = (await service.albums("visit")).albums.length;
await service.deleteAlbum(album.id);
report.gone = await service.album(album.id).catch((error) => error instanceof ServiceError && error.slug);
console.log(JSON.stringify(report));
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("node") is None or not (PACKAGE / "node_modules").is_dir(),
        reason="needs Node, and `npm ci` in clients/typescript",
    ),
]


def tsc(*arguments: str, cwd: Path) -> None:
    command = ["node", str(PACKAGE / "node_modules/typescript/bin/tsc"), *arguments]
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, text=True, timeout=300)
    assert done.returncode == 0, done.stdout


def run_node(folder: Path, *files: Path) -> str:
    """Run `run.js` of a folder; return what it prints."""
    command = ["node", "run.js", *map(str, files)]
    return subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, timeout=300, check=True).stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the compiled package installed."""
    root = tmp_path_factory.mktemp("node")
    subprocess.run(["node", "types.mjs"], cwd=PACKAGE, check=True, timeout=300)
    installed = root / "node_modules" / "lalaloc-client"
    tsc("--outDir", str(installed / "dist"), cwd=PACKAGE)
    shutil.copy(PACKAGE / "package.json", installed)
    (root / "package.json").write_text('{"type": "module"}')
    return root


def test_readme_example_works_in_node(start_app: StartApp, folder: Path, tmp_path: Path) -> None:
    (example,) = re.findall(r"```ts\n(.*?)```", (PACKAGE / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    with start_app(tmp_path / "data", bundle=default_bundle(), request_deadline_s=90.0) as app:
        address = str(app.base_url).rstrip("/")
        (folder / "example.ts").write_text(example.replace("http://127.0.0.1:8000", address))
        (folder / "run.js").write_text(_RUN.replace("ADDRESS", address))
        strict = ["--strict", "--target", "ES2022", "--module", "nodenext", "--lib", "ES2022,DOM,DOM.Iterable"]
        tsc(*strict, "example.ts", cwd=folder)
        files = [ROOT / "examples" / name for name in ("flat.json", "study.jpg")]
        camera = Perspective.of_hfov(360, 480, math.radians(53.0))
        for heading_deg in (0.0, 40.0):
            files.append(folder / f"{heading_deg:g}.jpg")
            files[-1].write_bytes(jpeg(take(sphere("study"), camera, heading_deg=heading_deg)))
        printed = run_node(folder, *files)
    rooms, heading, unread, unknown, given, overlap = printed.splitlines()
    assert re.fullmatch(r'\["(bedroom|study)","not localised: .*"\]', rooms, re.IGNORECASE), rooms
    assert 0.0 <= float(heading) < 360.0
    assert (unread, unknown) == ("null", "unknown-floorplan")
    assert [(angle["value_deg"], angle["source"]) for angle in json.loads(given)] == [(0, "given"), (40, "given")]
    first, second = json.loads(overlap)
    assert (first["source"], second["source"]) == ("estimated", "estimated")
    assert second["value_deg"] == pytest.approx(40.0, abs=4.0)


def test_album_is_pinned_corrected_and_deleted(
    start_app: StartApp, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One of the three is sent again, so that it is the last.
    monkeypatch.setattr(LocalLocaliser, "answer", busy_for(1))
    with start_app(tmp_path / "data", bundle=default_bundle(), request_deadline_s=90.0, sweep_s=0.2) as app:
        (folder / "run.js").write_text(_RUN_ALBUM.replace("ADDRESS", str(app.base_url).rstrip("/")))
        files = [ROOT / "examples" / name for name in ("flat.json", "kitchen.jpg", "study.jpg")]
        report = json.loads(run_node(folder, *files))
    assert sorted(report.pop("sent")) == [201, 201, 422]
    assert sorted(report.pop("rooms")) == ["kitchen", "study"]
    assert report == {
        "again": [200, 422, 200],
        "state": "solved",
        "corrected": ["set_aside", "sure"],
        "table": 3,
        "left": 1,
        "listed": 1,
        "gone": "unknown-album",
    }
