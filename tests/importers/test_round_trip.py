"""Export and import of the same plan."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile

import ezdxf
import pytest
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import EXPORT_FORMATS, Anchor, ImportOptions, export_plan, import_plan
from tests.importers.conftest import assert_same_plan

ANCHOR = Anchor(latitude=48.1372, longitude=11.5756, north_deg=25.0)


@pytest.mark.parametrize("format", ["native", "geojson", "dxf", "svg"])
def test_exported_plan_is_imported_unchanged(flat: FloorPlan, format):
    back = import_plan(export_plan(flat, format))
    assert_same_plan(back, flat.to_dict())
    assert {room["name"] for room in back.document["rooms"]} == {"bedroom", "living room", "corridor"}
    (walls,) = [room["walls"] for room in back.document["rooms"] if room.get("walls")]
    assert shapely.LineString(walls[0]).hausdorff_distance(shapely.LineString([[6.5, 3.2], [7.5, 3.2]])) < 2e-3
    assert back.report.warnings == ()
    back.plan()


@pytest.mark.slow
def test_equal_plans_give_equal_bytes_in_every_process(flat: FloorPlan):
    program = (
        "import hashlib, json, sys\nfrom lalaloc_core.floorplan import FloorPlan\n"
        "from lalaloc_core.importers import EXPORT_FORMATS, Anchor, export_plan\n"
        f"plan, anchor = FloorPlan.from_dict(json.load(sys.stdin)), {ANCHOR!r}\n"
        "print([hashlib.sha256(export_plan(plan, format, anchor)).hexdigest() for format in EXPORT_FORMATS])"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", program],
            input=json.dumps(flat.to_dict()),
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(outputs) == 1


def test_options_of_ezdxf_stay_as_they_are(flat: FloorPlan):
    export_plan(flat, "dxf")
    assert not ezdxf.options.write_fixed_meta_data_for_testing  # pyright: ignore[reportPrivateImportUsage]


@pytest.mark.parametrize("format", ["geojson", "imdf"])
def test_anchored_plan_is_imported_north_up(flat: FloorPlan, format):
    back = import_plan(export_plan(flat, format, ANCHOR))
    assert back.anchor is not None
    assert abs(back.anchor.latitude - ANCHOR.latitude) < 1e-3
    # The imported plan has north up: rotate it back by the anchor's north.
    turn = -ANCHOR.north_deg
    document = json.loads(json.dumps(back.document))

    def turned(points: list) -> list:
        rotated = shapely.affinity.rotate(shapely.MultiPoint(points), turn, origin=(0, 0))
        return shapely.get_coordinates(rotated).tolist()

    for room in document["rooms"]:
        room["polygon"] = turned(room["polygon"])
        room["holes"] = [turned(hole) for hole in room.get("holes", [])]
    for opening in document["openings"]:
        opening["line"] = turned(opening["line"])
    expected = flat.to_dict()
    assert_same_plan(type(back)(document, back.report), expected, within_m=5e-3, shift=True)
    assert document["north_deg"] == 0.0


def test_geojson_keeps_heights_and_types(flat: FloorPlan):
    document = flat.to_dict()
    document["openings"][2] |= {"sill_m": 0.9, "head_m": 2.1}
    back = import_plan(export_plan(FloorPlan.from_dict(document), "geojson")).document
    assert back["ceiling_height_m"] == 2.5
    assert [room["type"] for room in back["rooms"]] == ["bedroom", "living", "corridor"]
    (window,) = [opening for opening in back["openings"] if opening["kind"] == "window"]
    assert (window["sill_m"], window["head_m"]) == (0.9, 2.1)


def test_imdf_archive_conforms_to_the_standard(flat: FloorPlan):
    content = export_plan(flat, "imdf", ANCHOR)
    assert content == export_plan(flat, "imdf", ANCHOR)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert json.loads(archive.read("manifest.json"))["version"] == "1.0.0"
        files = {name for name in archive.namelist() if name.endswith(".geojson")}
        assert files == {f"{kind}.geojson" for kind in ("venue", "building", "footprint", "level", "unit", "opening")}
        (level,) = json.loads(archive.read("level.geojson"))["features"]
        units = json.loads(archive.read("unit.geojson"))["features"]
    assert all(unit["properties"]["level_id"] == level["id"] and unit["feature_type"] == "unit" for unit in units)


def test_invalid_exports_are_rejected(flat: FloorPlan):
    with pytest.raises(InvalidFloorPlanError, match="anchor"):
        export_plan(flat, "imdf")
    with pytest.raises(InvalidFloorPlanError, match="set it to one of native, geojson, imdf, dxf, svg, ros"):
        export_plan(flat, "dwg")
    assert set(EXPORT_FORMATS) == {"native", "geojson", "imdf", "dxf", "svg", "ros"}


def test_scale_option_overrides_an_exported_scale(flat: FloorPlan):
    back = import_plan(export_plan(flat, "svg"), ImportOptions(metres_per_pixel=0.005))
    x0, _, x1, _ = back.plan().bounds_m
    assert x1 - x0 == pytest.approx(4.5)
