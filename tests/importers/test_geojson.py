"""GeoJSON of mapping tools and OpenStreetMap, and IMDF archives."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import LocalFrame
from lalaloc_core.importers import ImportLimits, ImportOptions, import_plan, import_plans
from tests.importers.conftest import lines, shapes, zip_file

PLACE = LocalFrame(longitude=-0.1276, latitude=51.5072)


def _feature(points: list, geometry: str = "Polygon", **properties: object) -> dict:
    coordinates = PLACE.to_earth(np.array(points, dtype=float)).tolist()
    if geometry == "Polygon":
        coordinates = [[*coordinates, coordinates[0]]]
    return {"type": "Feature", "properties": properties, "geometry": {"type": geometry, "coordinates": coordinates}}


def _collection(*features: dict, **members: object) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": list(features), **members}).encode()


KITCHEN = _feature([[0, 0], [4, 0], [4, 3], [0, 3]], indoor="room", name="Küche", level="0")
HALL = _feature([[0, 3.2], [4, 3.2], [4, 6], [0, 6]], indoor="corridor", level="0;1")
DOOR = _feature([[1, 3.1], [1.9, 3.1]], "LineString", door="hinged", level="0")


def test_osm_indoor_tags_give_one_plan_per_level():
    ground, first = import_plans(_collection(KITCHEN, HALL, DOOR))
    assert (ground.level.number, first.level.number) == (0.0, 1.0)  # type: ignore[union-attr]
    assert [room["type"] for room in ground.document["rooms"]] == ["kitchen", "corridor"]
    assert len(first.document["rooms"]) == 1
    assert lines(ground.document, "door")[0].length == pytest.approx(0.9, abs=1e-3)
    assert shapes(ground.document)[0].area == pytest.approx(12.0, abs=1e-3)


def test_level_option_selects_a_level():
    with pytest.raises(InvalidFloorPlanError, match=r"2 levels: '0', '1'; choose one with `level`"):
        import_plan(_collection(KITCHEN, HALL))
    assert len(import_plan(_collection(KITCHEN, HALL), ImportOptions(level="1")).document["rooms"]) == 1
    with pytest.raises(InvalidFloorPlanError, match="no level '7'; set level to one of '0', '1'"):
        import_plan(_collection(KITCHEN, HALL), ImportOptions(level="7"))


def test_anchor_gives_the_place_of_the_plan():
    plan = import_plan(_collection(KITCHEN, HALL), ImportOptions(level="0"))
    corner = np.array(plan.document["rooms"][0]["polygon"][0])
    frame = LocalFrame(plan.anchor.longitude, plan.anchor.latitude)  # type: ignore[union-attr]
    geod = pyproj.Geod(ellps="WGS84")
    (lon, lat), (true_lon, true_lat) = frame.to_earth(corner[None])[0], PLACE.to_earth(np.zeros((1, 2)))[0]
    _, _, apart = geod.inv(lon, lat, true_lon, true_lat)
    assert apart < 1e-3
    assert plan.document["north_deg"] == 0.0


def test_drawing_in_millimetres_needs_units():
    room = {"type": "Polygon", "coordinates": [[[0, 0], [4000, 0], [4000, 3000], [0, 3000], [0, 0]]]}
    content = json.dumps(room).encode()
    with pytest.raises(InvalidFloorPlanError, match=r"outside longitude .* and latitude .*units=m"):
        import_plan(content)
    plan = import_plan(content, ImportOptions(units="mm"))
    assert shapes(plan.document)[0].area == pytest.approx(12.0)
    assert plan.anchor is None


def test_projected_crs_is_converted():
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    ring = [[691000 + x, 5334000 + y] for x, y in ([0, 0], [4, 0], [4, 3], [0, 3], [0, 0])]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    plan = import_plan(_collection(feature, crs=crs))
    # The scale of the grid differs from 1 by a few parts in ten thousand.
    assert shapes(plan.document)[0].area == pytest.approx(12.0, rel=2e-3)
    assert plan.anchor.latitude == pytest.approx(48.13, abs=0.02)  # type: ignore[union-attr]


def test_imdf_kiosks_are_holes_and_windows_are_kept():
    shaft = _feature([[1, 1], [1.5, 1], [1.5, 1.5], [1, 1.5]], feature_type="kiosk", level_id="L")
    unit = _feature([[0, 0], [4, 0], [4, 3], [0, 3]], feature_type="unit", category="restroom",
                    name={"de": "Bad", "en": "Bath"}, level_id="L")  # fmt: skip
    passage = _feature([[1, 0], [2, 0]], "LineString", feature_type="opening", door=None, level_id="L")
    window = _feature([[2.5, 0], [3.5, 0]], "LineString", feature_type="opening", kind="window", level_id="L")
    third = {"ordinal": 3, "name": {"en": "Third"}}
    levels = [{"id": "L", "type": "Feature", "geometry": None, "properties": third}]
    features = {"level": levels, "unit": [unit], "kiosk": [shaft], "opening": [passage, window]}
    files = {f"venue/{kind}.geojson": _collection(*members) for kind, members in features.items()}
    plan = import_plan(zip_file({"manifest.json": "{}"} | files))
    assert (plan.level.name, plan.level.number) == ("Third", 3.0)  # type: ignore[union-attr]
    (room,) = plan.document["rooms"]
    assert (room["name"], room["type"], len(room["holes"])) == ("Bath", "bathroom", 1)
    assert (len(lines(plan.document, "passage")), len(lines(plan.document, "window"))) == (1, 1)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"type": "FeatureCollection", "features": 3}, "is of type int; it must be a list"),
        ({"type": "FeatureCollection", "features": []}, "no features with a geometry"),
        ({"type": "FeatureCollection", "features": [{"type": "Thing"}]}, "feature 0 is not a GeoJSON Feature"),
        ({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": "x"}}, "geometry of the feature"),
        ({"type": "Point", "coordinates": [1, 2]}, "no room was found"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}, "the limit for a plan"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [1e400, 0], [1, 1], [0, 0]]]}, "is not a GeoJSON geometry"),
    ],
)
def test_invalid_documents_are_rejected(document: dict, message: str):
    with pytest.raises(InvalidFloorPlanError, match=message):
        import_plan(json.dumps(document).encode())


def test_too_many_vertices_are_rejected():
    ring = [[0.00001 * i, 0.00001 * (i % 7)] for i in range(3000)]
    content = json.dumps({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}).encode()
    with pytest.raises(InvalidFloorPlanError, match="more than 1000 entities"):
        import_plan(content, limits=ImportLimits(max_entities=1000))


def test_archive_without_units_is_rejected_with_its_files():
    cases = (("readme.txt", "", "no GeoJSON at all"), ("venue/level.geojson", _collection(), "venue/level.geojson"))
    for name, content, listed in cases:
        with pytest.raises(InvalidFloorPlanError, match=f"no unit.geojson, it has {listed}"):
            import_plan(zip_file({name: content}))
