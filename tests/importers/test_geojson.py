"""GeoJSON of mapping tools and OpenStreetMap, and IMDF archives."""

from __future__ import annotations

import json
import math
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import PlanLimits
from lalaloc_core.floorplan.earth import LocalFrame
from lalaloc_core.importers import ImportLimits, ImportOptions, building_name, import_plan, import_plans
from tests.importers.conftest import lines, shapes, zip_file

PLACE = LocalFrame(longitude=-0.1276, latitude=51.5072)


def _feature(points: list, geometry: str = "Polygon", **properties: object) -> dict:
    coordinates = PLACE.to_earth(np.atleast_2d(np.array(points, dtype=float))).tolist()
    if geometry == "Point":
        (coordinates,) = coordinates
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
    named = import_plans(_collection(KITCHEN, HALL, DOOR), ImportOptions(name="Duplex"))
    assert [plan.plan().name for plan in named] == ["Duplex – Level 0", "Duplex – Level 1"]
    assert lines(ground.document, "door")[0].length == pytest.approx(0.9, abs=1e-3)
    assert shapes(ground.document)[0].area == pytest.approx(12.0, abs=1e-3)


def test_levels_are_in_the_order_of_their_numbers_without_roofs():
    levels = [
        _feature([[0, 0], [4, 0], [4, 3]], indoor="room", name=f"room on {name}", level=name)
        for name in ("Floor 10", "Floor 2", "Dach", "Roof terrace")
    ]
    plans = import_plans(_collection(*levels))
    assert [plan.level.name for plan in plans] == ["Floor 2", "Floor 10", "Roof terrace"]  # type: ignore[union-attr]
    assert "level 'Dach' was left out: it is a roof (set level to read it)" in plans[0].report.warnings
    (roof,) = import_plans(_collection(*levels), ImportOptions(level="Dach"))
    assert len(roof.document["rooms"]) == 1
    # A file with nothing but roofs is read.
    assert len(import_plans(_collection(levels[2]))) == 1


def test_invalid_level_is_named():
    huge = _feature([[0, 0], [9e3, 0], [9e3, 9e3]], indoor="room", name="Halle", level="1")
    content = _collection(KITCHEN, huge)
    with pytest.raises(InvalidFloorPlanError, match=r"level '1': "):
        import_plans(content)
    assert import_plan(content, ImportOptions(level="0")).document["rooms"][0]["name"] == "Küche"


def test_too_many_levels_are_rejected():
    rooms = [KITCHEN | {"properties": KITCHEN["properties"] | {"level": str(level)}} for level in range(201)]
    with pytest.raises(InvalidFloorPlanError, match=r"201 levels; the limit is 200 \(max_levels\)"):
        import_plans(_collection(*rooms))
    assert import_plan(_collection(*rooms), ImportOptions(level="200")).level is not None


def test_rooms_on_many_levels_count_as_entities():
    ring = [[math.cos(turn), math.sin(turn)] for turn in np.linspace(0.0, 6.0, 2000)]
    tower = _feature(ring, indoor="room", level="0-199")
    with pytest.raises(InvalidFloorPlanError, match="more than 300000 entities"):
        import_plans(_collection(tower))


@pytest.mark.parametrize(
    ("file_name", "name"),
    [
        ("Duplex.ifc", "Duplex"),
        ("C:\\plans\\12 Mill Lane.imdf.zip", "12 Mill Lane"),
        ("/plans/level 1.2/Haus", "Haus"),
        (".json", ".json"),
        ("", None),
        (None, None),
    ],
)
def test_building_is_named_by_its_file(file_name: str | None, name: str | None):
    assert building_name(file_name) == name


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


@pytest.mark.parametrize(
    ("longitude", "latitude", "swapped", "said"),
    [
        (139.7, 35.7, True, "the latitude would be 139.7°"), (-118.2, 34.1, True, "the latitude would be -118.2°"),
        (88.4, 22.6, True, "the latitude would be 88.4°"), (139.7, 35.7, False, ""), (-88.4, 22.6, False, ""),
        (13.4, 52.5, False, "taken for longitude 13.400° and latitude 52.500°"),
        (13.4, 52.5, True, "taken for longitude 52.500° and latitude 13.400°"),
    ],
)  # fmt: skip
def test_order_of_coordinates_is_found_or_said(longitude: float, latitude: float, swapped: bool, said: str):
    points = LocalFrame(longitude, latitude).to_earth(np.array([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], dtype=float))
    ring = points[:, ::-1] if swapped else points
    report = (plan := import_plan(json.dumps({"type": "Polygon", "coordinates": [ring.tolist()]}).encode())).report
    lines_said = [line for line in (*report.warnings, *report.unsure) if "exchange the two" in line]
    assert [said in line for line in lines_said] == [True] * bool(said)
    if "taken" not in said:
        assert shapes(plan.document)[0].area == pytest.approx(12.0, abs=1e-3)


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


def test_large_rooms_in_wgs84_give_no_warning_about_units():
    hall = _feature([[0, 0], [60, 0], [60, 50], [0, 50]], indoor="room")
    gate = _feature([[5, 0], [13, 0]], "LineString", feature_type="opening")
    assert import_plan(_collection(hall, gate)).report.warnings == ()
    drawn = {"type": "Polygon", "coordinates": [[[0, 0], [60, 0], [60, 50], [0, 50], [0, 0]]]}
    (warning,) = import_plan(json.dumps(drawn).encode(), ImportOptions(units="m")).report.warnings
    assert "looks like feet" in warning


def test_round_rooms_are_simplified_within_two_centimetres():
    turn = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    round_m = 9.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    content = _collection(_feature(round_m.tolist(), indoor="room", name="Rotunda"))
    plan = import_plan(content, limits=ImportLimits(plan=PlanLimits(max_vertices_per_room=70)))
    (room,) = shapes(plan.document)
    assert len(room.exterior.coords) <= 71
    assert shapely.hausdorff_distance(room, shapely.Polygon(round_m)) < 0.021
    assert "simplified within 2 cm" in plan.report.notes[0]
    with pytest.raises(InvalidFloorPlanError, match=r"room 'Rotunda': .* limit is 20 \(max_vertices\)"):
        import_plan(content, limits=ImportLimits(plan=PlanLimits(max_vertices_per_room=20)))


# Simple Indoor Tagging: positions (m) by node, and tags. The door is a node on the wall of both rooms.
NODES = {1: (0, 0), 2: (4, 0), 3: (4, 1), 4: (4, 3), 5: (0, 3), 6: (9, 0), 7: (9, 3), 8: (2, 3), 9: (6, 3)}
NODE_TAGS = {3: {"door": "yes", "width": "1.1", "height": "210 cm"}, 8: {"window": "yes", "level": "0"},
             9: {"entrance": "yes"}}  # fmt: skip
ROOMS = {"Ward": [1, 2, 3, 4, 8, 5, 1], "Hall": [2, 6, 7, 9, 4, 3, 2]}


def _osm_elements() -> list[dict]:
    places = {key: PLACE.to_earth(np.array([xy], dtype=float))[0].round(8) for key, xy in NODES.items()}
    nodes = [
        {"type": "node", "id": key, "lat": float(lat), "lon": float(lon), "tags": NODE_TAGS.get(key, {})}
        for key, (lon, lat) in places.items()
    ]
    ways = [
        {"type": "way", "id": 20 + i, "nodes": ring, "tags": {"indoor": "room", "name": name, "level": "0-1",
                                                             "height": "2.8 m"}}
        for i, (name, ring) in enumerate(ROOMS.items())
    ]  # fmt: skip
    path = {"type": "way", "id": 30, "nodes": [1, 6, 7], "tags": {"highway": "footway"}}
    return [*nodes, *ways, path]


def _osm_xml(elements: list[dict]) -> bytes:
    root = ElementTree.Element("osm", version="0.6")
    for element in elements:
        attributes = {key: str(element[key]) for key in ("id", "lat", "lon") if key in element}
        child = ElementTree.SubElement(root, element["type"], attributes)
        for node in element.get("nodes", ()):
            ElementTree.SubElement(child, "nd", ref=str(node))
        for key, value in element["tags"].items():
            ElementTree.SubElement(child, "tag", k=key, v=value)
    return ElementTree.tostring(root, xml_declaration=True, encoding="UTF-8")


def _osm_geojson(elements: list[dict]) -> bytes:
    tagged = [element for element in elements if "indoor" in element["tags"]]
    rooms = [_feature([NODES[key] for key in element["nodes"][:-1]], **element["tags"]) for element in tagged]
    points = [_feature(list(NODES[key]), "Point", **tags) for key, tags in NODE_TAGS.items()]
    return _collection(*rooms, *points)


@pytest.mark.parametrize(
    "content",
    [json.dumps({"version": 0.6, "elements": _osm_elements()}).encode(), _osm_xml(_osm_elements()),
     _osm_geojson(_osm_elements())],
    ids=["Overpass JSON", "OSM XML", "GeoJSON"],
)  # fmt: skip
def test_openings_that_are_nodes_lie_along_their_walls(content: bytes):
    ground, first = import_plans(content)
    assert {room["name"] for room in ground.document["rooms"]} == {"Ward", "Hall"}
    assert ground.document["ceiling_height_m"] == 2.8
    inner, entrance = sorted(lines(ground.document, "door"), key=lambda line: line.centroid.y)
    assert (inner.length, entrance.length) == pytest.approx((1.1, 0.9), abs=1e-2)
    assert abs(inner.coords[0][0] - inner.coords[1][0]) < 1e-2
    assert max(opening.get("head_m", 0.0) for opening in ground.document["openings"]) == 2.1
    assert lines(ground.document, "window")[0].length == pytest.approx(1.2, abs=1e-2)
    # Nodes without a level belong to every level of their wall.
    assert (len(lines(first.document, "door")), len(lines(first.document, "window"))) == (2, 0)
    assert any("0.9 m is assumed" in text for text in ground.report.unsure)


def test_rings_of_an_osm_relation_are_joined():
    elements = _osm_elements()
    for way, nodes in ((40, [1, 2, 6, 7]), (41, [7, 4, 5, 1])):
        elements.append({"type": "way", "id": way, "nodes": nodes, "tags": {}})
    members = [{"type": "way", "ref": way, "role": "outer"} for way in (40, 41)]
    tags = {"type": "multipolygon", "indoor": "area", "name": "Floor", "level": "7"}
    elements.append({"type": "relation", "id": 50, "members": members, "tags": tags})
    plan = import_plan(json.dumps({"elements": elements}).encode(), ImportOptions(level="7"))
    assert shapes(plan.document)[0].area == pytest.approx(27.0, abs=1e-2)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"type": "FeatureCollection", "features": 3}, "is of type int; it must be a list"),
        ({"type": "FeatureCollection", "features": []}, "no features with a geometry"),
        ({"type": "FeatureCollection", "features": [{"type": "Thing"}]}, "feature 0 is not a GeoJSON Feature"),
        ({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": "x"}}, "geometry of the feature"),
        ({"type": "Point", "coordinates": [1, 2]}, "no room was found"),
        (
            {"elements": [{"type": "node", "id": 1, "lat": 1.0, "lon": 1.0}]},
            "no way with the tag 'indoor'.*Overpass query",
        ),
        ({"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}, "the limit for a plan"),
        (
            {"type": "Polygon", "coordinates": [[[0, 0], [1e400, 0], [1, 1], [0, 0]]]},
            "the number inf; the limit is 1e\\+10",
        ),
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
