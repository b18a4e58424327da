"""Floor plan files over HTTP: formats, options, reports, hostile files, and worker failures."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import shapely
from ezdxf.filemanagement import new as new_dxf
from PIL import Image

from benchmarks.hostile_drawings import HOSTILE_PLANS
from benchmarks.plan_drawing import draw_plan
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import Anchor, export_plan
from tests.importers.conftest import FLAT as PLAN
from tests.importers.conftest import ZIP_BOMB, dxf_file, large_picture
from tests.importers.test_ifc import ifc_flat
from tests.importers.test_pictures import hall_beside_a_photograph, open_hall, vector_pdf
from tests.painted import picture_file
from tests.service.conftest import StartApp, assert_problem, document_of, end_time_limits, localise, wait_for

EXAMPLES = Path(__file__).parents[2] / "examples"
ANCHOR = Anchor(latitude=48.1372, longitude=11.5756, north_deg=25.0)


def send_plan(client: httpx.Client, content: bytes, **options: Any) -> httpx.Response:
    fields = {name: str(value) for name, value in options.items()}
    return client.post("/floorplans", files={"file": ("plan", content)}, data=fields)


def store_plan(client: httpx.Client, content: bytes, **options: Any) -> dict[str, Any]:
    return document_of(send_plan(client, content, **options), 201)


def plan_file(format: str) -> bytes:
    """Return the plan of three rooms as a file."""
    return export_plan(FloorPlan.from_dict(json.loads(json.dumps(PLAN))), format, ANCHOR if format == "imdf" else None)


def import_workers() -> set[int]:
    """Return the process ids of the import workers of all running apps."""
    children = [child for child in multiprocessing.active_children() if child.name.startswith("lalaloc-import")]
    return {child.pid for child in children if child.pid is not None}


@pytest.mark.parametrize(
    ("format", "media"),
    [
        ("native", "application/json"),
        ("geojson", "application/geo+json"),
        ("imdf", "application/zip"),
        ("dxf", "image/vnd.dxf"),
        ("svg", "image/svg+xml"),
    ],
)
def test_file_is_imported_and_kept(client: httpx.Client, format: str, media: str) -> None:
    content = plan_file(format)
    plan = store_plan(client, content)
    assert sorted(room["name"] for room in plan["rooms"]) == ["bedroom", "corridor", "living room"]
    kinds = sorted(opening["kind"] for opening in plan["plan"]["openings"])
    assert kinds == ["door", "door", "passage", "window"]
    report = plan["import_report"]
    assert report["format"] == format
    assert not report["is_draft"]
    assert report["layers"]
    assert client.get(f"/floorplans/{plan['id']}").json()["import_report"] == report
    original = client.get(f"/floorplans/{plan['id']}/original")
    assert original.content == content
    assert original.headers["content-type"] == media
    assert original.headers["x-content-type-options"] == "nosniff"
    assert "default-src 'none'" in original.headers["content-security-policy"]


def test_ifc_model_is_imported(client: httpx.Client) -> None:
    plan = store_plan(client, ifc_flat().content())
    assert [(room["name"], room["type"]) for room in plan["rooms"]] == [("Küche", "kitchen"), ("Wohnen", "living")]
    assert plan["import_report"]["level"] == {"name": "EG", "number": 0.0, "elevation_m": 0.0}


def test_pdf_is_a_draft(client: httpx.Client) -> None:
    plan = store_plan(client, vector_pdf())
    assert plan["import_report"]["is_draft"]
    assert sorted(room["name"] for room in plan["rooms"]) == ["Kitchen", "Wohnzimmer"]
    assert plan["import_report"]["scale_source"] == "1:100, written in the drawing"


@pytest.mark.slow
def test_picture_without_scale_gets_an_estimate_with_its_error_and_clues(client: httpx.Client) -> None:
    drawn = draw_plan("thick", 1)
    plan = store_plan(client, drawn.png())
    report = plan["import_report"]
    assert 0.0 < report["scale_std"] < 0.1
    assert report["metres_per_unit"] == pytest.approx(drawn.metres_per_pixel, rel=3.0 * report["scale_std"])
    assert {"leaf", "wall"} <= {clue["kind"] for clue in report["scale_clues"]}
    assert any("is assumed" in warning for warning in plan["warnings"])
    twice = store_plan(client, drawn.png(), metres_per_pixel=drawn.metres_per_pixel, multiply=2.0)
    assert twice["import_report"]["metres_per_unit"] == pytest.approx(2.0 * drawn.metres_per_pixel)
    part = store_plan(client, drawn.png(), metres_per_pixel=drawn.metres_per_pixel, crop="0,0,5000,5000", name="Drawn")
    assert (part["name"], len(part["rooms"])) == ("Drawn", len(drawn.rooms))
    assert part["import_report"]["is_draft"]
    assert any("ceiling height" in line for line in part["import_report"]["unsure"])
    assert client.get(f"/floorplans/{part['id']}/original").headers["content-type"] == "image/png"


@pytest.mark.parametrize("format", ["native", "geojson", "dxf", "svg", "imdf", "pdf"])
def test_plan_without_a_name_is_named_after_its_file(client: httpx.Client, format: str) -> None:
    if format in ("native", "geojson"):
        unnamed = {key: value for key, value in json.loads(plan_file(format)).items() if key != "name"}
        content = json.dumps(unnamed).encode()
    else:
        content = vector_pdf() if format == "pdf" else plan_file(format)

    def name_of(**form: Any) -> str:
        return client.post("/floorplans", **form).json()["plan"]["name"]

    assert name_of(files={"file": ("C:\\plans\\ground floor.v2.x", content)}) == "ground floor.v2"
    assert name_of(files={"file": ("ground floor.x", content)}, data={"name": "Home"}) == "Home"
    assert name_of(content=content, headers={"content-type": "application/octet-stream"}) == "floor plan"


def test_preview_marks_what_became_no_room(client: httpx.Client) -> None:
    plan = store_plan(client, open_hall(), metres_per_pixel=0.01)
    (outline,) = plan["import_report"]["no_room"]
    assert shapely.Polygon(outline).area == pytest.approx(11.2, rel=0.1)
    assert client.get(f"/floorplans/{plan['id']}/preview.svg").text.count('class="no-room"') == 1
    # A corrected plan has no such area.
    client.put(f"/floorplans/{plan['id']}", json=plan["plan"])
    assert "no-room" not in client.get(f"/floorplans/{plan['id']}/preview.svg").text


def test_likely_mistakes_are_warnings(client: httpx.Client) -> None:
    square = [[0, 0], [4, 0], [4, 3], [0, 3]]
    plan = {
        "ceiling_height_m": 8,
        "rooms": [
            {"name": "hall", "polygon": square},
            {"name": "hall", "polygon": [[x + 4.1, y] for x, y in square]},
            {"name": "over", "polygon": [[x + 6, y] for x, y in square]},
            {"name": "shed", "polygon": [[x + 30, y] for x, y in square]},
        ],
        "openings": [{"kind": "door", "line": [[4.05, 1], [4.05, 1.9]]}],
    }
    answer = client.post("/floorplans", json=plan).json()
    warnings = "\n".join(answer["warnings"])
    for words in ("it looks like feet", "share a name: 'hall'", "'shed'", "no door or passage reaches", "overlap"):
        assert words in warnings
    assert client.get(f"/floorplans/{answer['id']}").json()["warnings"] == answer["warnings"]


def test_y_axis_down_gives_a_warning(client: httpx.Client) -> None:
    document = new_dxf()
    document.header["$UCSYDIR"] = (0, -1, 0)
    room = document.modelspace().add_lwpolyline([(0, 0), (4, 0), (4, 3), (0, 3)], dxfattribs={"layer": "ROOM"})
    room.close()
    assert any("y" in line and "down" in line for line in store_plan(client, dxf_file(document))["warnings"])


def test_file_as_body_is_detected_by_content(client: httpx.Client) -> None:
    for media in ("image/vnd.dxf", "application/octet-stream", "application/json"):
        response = client.post("/floorplans", content=plan_file("dxf"), headers={"content-type": media})
        assert document_of(response, 201)["import_report"]["format"] == "dxf"


def test_several_levels_require_the_level_option(client: httpx.Client) -> None:
    collection = json.loads(plan_file("geojson"))
    upper = json.loads(json.dumps(collection["features"]))
    for level, features in (("0", collection["features"]), ("1", upper)):
        for feature in features:
            feature["properties"]["level"] = level
            feature.pop("id", None)
    collection["features"] += upper
    content = json.dumps(collection).encode()
    problem = assert_problem(send_plan(client, content), 422, "several-levels")
    assert problem["levels"] == ["0", "1"]
    assert "2 levels: '0', '1'; choose one with `level`" in problem["detail"]
    assert store_plan(client, content, level="1")["import_report"]["level"]["name"] == "1"
    nowhere = assert_problem(send_plan(client, content, level="7"), 422, "invalid-floorplan")
    assert "has no level '7'; set level to one of '0', '1'" in nowhere["detail"]


@pytest.mark.parametrize(
    ("options", "field", "words"),
    [
        ({"units": "miles"}, "units", "set it to one of m, cm, mm, in, ft"),
        ({"scale": "large"}, "scale", "must look like 1:100"),
        ({"metres_per_pixel": "1_0"}, "metres_per_pixel", "must be a number"),
        ({"metres_per_pixel": "99"}, "metres_per_pixel", "between 1e-06 and 10"),
        ({"known_distance": "1,2,3"}, "known_distance", "has 3 numbers"),
        ({"page": "0"}, "page", "between 1 and"),
        ({"y_axis": "left"}, "y_axis", "set it to up or down"),
        ({"scale": "1:50", "metres_per_pixel": "0.01"}, "scale", "give only one of them"),
        ({"plan": "perhaps"}, "plan", "must be true or false"),
        ({"color": "red"}, "color", "unknown part"),
    ],
)
def test_invalid_option_is_named(client: httpx.Client, options: dict[str, str], field: str, words: str) -> None:
    problem = assert_problem(send_plan(client, plan_file("svg"), **options), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]
    assert words in problem["errors"][0]["message"]


def test_unused_option_gives_a_warning(client: httpx.Client) -> None:
    plan = store_plan(client, plan_file("native"), level="2")
    assert "the option 'level' was ignored: it does not apply to native JSON" in plan["warnings"]


def test_picture_that_looks_like_a_photograph_is_read_with_plan_true(client: httpx.Client) -> None:
    content, options = hall_beside_a_photograph(), {"metres_per_pixel": 0.01, "crop": "0,0,1100,500"}
    assert "set plan=true" in assert_problem(send_plan(client, content, **options), 422, "invalid-floorplan")["detail"]
    notes = store_plan(client, content, **options, plan=True)["import_report"]["notes"]
    assert len([note for note in notes if "because plan=true is set" in note]) == 1


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"hello there", "in no known format; supported formats are"),
        (b'{"type": "FeatureCollection", "features": []}', "no features"),
        (b"   ", "the body is empty"),
    ],
)
def test_other_files_are_rejected_with_a_remedy(client: httpx.Client, content: bytes, words: str) -> None:
    assert words in assert_problem(send_plan(client, content), 422, "invalid-floorplan")["detail"]


def test_file_replaces_a_plan(client: httpx.Client) -> None:
    plan = store_plan(client, plan_file("native"))
    content = plan_file("svg")
    answer = client.put(f"/floorplans/{plan['id']}", files={"file": ("plan.svg", content)}, data={"name": "Anew"})
    replaced = document_of(answer)
    assert (replaced["name"], replaced["import_report"]["format"]) == ("Anew", "svg")
    assert client.get(f"/floorplans/{plan['id']}/original").content == content


def test_idempotency_key_covers_the_options(client: httpx.Client) -> None:
    def upload(**fields: str) -> httpx.Response:
        file = {"file": ("plan", plan_file("svg"))}
        return client.post("/floorplans", files=file, data=fields, headers={"Idempotency-Key": "a-file"})

    first = upload(name="one")
    assert first.status_code == 201
    again = upload(name="one")
    assert (again.content, again.headers["idempotency-replayed"]) == (first.content, "true")
    assert_problem(upload(name="two"), 422, "idempotency-key-reused")


@pytest.fixture(scope="module")
def strict(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    limits: dict[str, Any] = {"max_unpacked_bytes": 1_000_000, "max_entities": 3000, "max_plan_pixels": 1_000_000}
    with start_app(tmp_path_factory.mktemp("strict"), **limits) as client:
        reported = client.get("/limits").json()
        assert {name: reported[name] for name in limits} == limits
        yield client


class TestHostileFiles:
    """Files made to exhaust resources are rejected, and the service handles the next request."""

    def assert_rejected(self, client: httpx.Client, content: bytes, words: str) -> None:
        problem = assert_problem(send_plan(client, content, metres_per_pixel=0.01), 422, "invalid-floorplan")
        assert words in problem["detail"]
        assert store_plan(client, plan_file("svg"))["rooms"]

    def test_files_above_the_limits(self, strict: httpx.Client) -> None:
        self.assert_rejected(strict, ZIP_BOMB, "more than 1000000 bytes (max_unpacked_bytes)")
        self.assert_rejected(strict, large_picture(30_000), "pixels")
        document = new_dxf()
        for x in range(4000):
            document.modelspace().add_line((x, 0), (x, 1))
        self.assert_rejected(strict, dxf_file(document), "more than 3000 entities (max_entities)")

    @pytest.mark.slow
    def test_nested_forms_of_a_pdf(self, strict: httpx.Client) -> None:
        (plan,) = (each for each in HOSTILE_PLANS if each.title == "nested forms")
        self.assert_rejected(strict, plan.make(20_000), "two attempts ended before the end of it")


@pytest.mark.slow
@pytest.mark.one_replica
def test_stalled_worker_is_replaced(start_app: StartApp, tmp_path: Path) -> None:
    earlier = import_workers()
    with start_app(tmp_path) as client, ThreadPoolExecutor(1) as threads:
        assert import_workers() == earlier, "workers start with the first file"
        store_plan(client, plan_file("svg"))
        (pid,) = import_workers() - earlier
        os.kill(pid, signal.SIGSTOP)
        stalled = threads.submit(send_plan, client, plan_file("dxf"))
        # Other pools of the process may run a limit before the job does.
        wait_for(lambda: end_time_limits() >= 0 and stalled.done())
        problem = assert_problem(stalled.result(), 422, "invalid-floorplan")
        assert "more than 40 s of CPU time (max_import_s is 30)" in problem["detail"]
        wait_for(lambda: client.get("/readyz").json()["import_pool"]["ready"] == 1)
        # A killed worker loses no upload.
        (pid,) = import_workers() - earlier
        os.kill(pid, signal.SIGKILL)
        assert store_plan(client, plan_file("svg"))["rooms"]
    assert import_workers() == earlier, "the pool left a process behind"


@pytest.mark.one_replica
def test_file_above_the_memory_limit_is_rejected(start_app: StartApp, tmp_path: Path) -> None:
    picture = picture_file(Image.new("L", (9_000, 9_000), 255))
    with start_app(tmp_path, import_memory_bytes=256 * 2**20, max_plan_pixels=10**9) as client:
        response = send_plan(client, picture, metres_per_pixel=0.001)
        assert "memory" in assert_problem(response, 422, "invalid-floorplan")["detail"]
        assert store_plan(client, plan_file("svg"))["rooms"]


def test_example_is_localised_in_an_imported_drawing(start_app: StartApp, tmp_path: Path) -> None:
    plan = FloorPlan.from_json((EXAMPLES / "flat.json").read_bytes())
    bundle = Path(__file__).parents[2] / "models" / "default"
    truth = next(pose for pose in json.loads((EXAMPLES / "poses.json").read_text()) if pose["room"] == "kitchen")
    picture = (EXAMPLES / truth["file"]).read_bytes()
    with start_app(tmp_path, bundle=bundle) as client:
        for format in ("dxf", "svg", "geojson"):
            made = store_plan(client, export_plan(plan, format), ceiling_height_m=2.6)
            assert made["status"] == "ready"
            answer = document_of(localise(client, made["id"], picture, heading_deg=truth["heading_deg"], refine="vdr"))
            assert answer["room"] == "kitchen"
            position = shapely.Point(answer["position"]["x_m"], answer["position"]["y_m"])
            assert position.distance(shapely.Point(truth["x_m"], truth["y_m"])) < 0.3
