"""Drawing, mesh and layout of a plan: scale, names, marker, openings."""

from __future__ import annotations

import io
import math
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st

from lalaloc_core.draw.plan import Marker, plan_svg
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from service.plan_files.plan_mesh import plan_glb
from tests.service.conftest import FLAT, assert_problem, upload
from tests.strategies import plan_of, rectangle

SVG = "{http://www.w3.org/2000/svg}"
_L_SHAPE = [[0, 0], [4, 0], [4, 1], [1, 1], [1, 5], [0, 5]]
L_ROOM = {"ceiling_height_m": 3.0, "rooms": [{"name": "L", "polygon": _L_SHAPE}]}


def test_drawing_has_every_room_with_y_up() -> None:
    plan = FloorPlan.from_dict(FLAT)
    root = ElementTree.fromstring(plan_svg(plan))
    drawn = [
        np.array([[float(value) for value in point.split(",")] for point in polygon.attrib["points"].split()])
        for polygon in root.iter(f"{SVG}polygon")
    ]
    for room, points in zip(plan.rooms, drawn, strict=True):
        np.testing.assert_allclose(points * [1, -1], room.polygon_m, atol=1e-3)
    x, y, width, height = (float(value) for value in root.attrib["viewBox"].split())
    x_min, y_min, x_max, y_max = plan.bounds_m
    assert x < x_min < x_max < x + width
    assert y < -y_max < -y_min < y + height


@given(st.text(min_size=1, max_size=200))
@example("<b>&\"'")
@example("\ufffe \uffff")
def test_valid_name_gives_well_formed_svg(name: str) -> None:
    document = {"name": name, "ceiling_height_m": 2.5, "rooms": [{"name": name, "polygon": [[0, 0], [3, 0], [0, 3]]}]}
    try:
        plan = FloorPlan.from_dict(document)
    except InvalidFloorPlanError:
        return
    root = ElementTree.fromstring(plan_svg(plan))
    drawn = next(root.iter(f"{SVG}text")).text
    assert drawn == name.replace("\ufffe", "\ufffd").replace("\uffff", "\ufffd")


@pytest.mark.parametrize("size_m", [(400.0, 3.0), (3.0, 400.0), (400.0, 300.0), (3.0, 2.0)])
def test_scale_bar_lies_within_the_drawing(size_m: tuple[float, float]) -> None:
    root = ElementTree.fromstring(plan_svg(plan_of(rectangle(*size_m))))
    left, top, seen_width, seen_height = (float(value) for value in root.attrib["viewBox"].split())
    (scale,) = [group for group in root.iter(f"{SVG}g") if group.get("class") == "scale"]
    label = next(scale.iter(f"{SVG}text"))
    size = float(label.attrib["font-size"])
    # Letters reach a quarter of their size below the line and are no wider than high.
    assert top + size_m[1] < float(label.attrib["y"]) < top + seen_height - size / 4.0
    assert left <= float(label.attrib["x"]) < left + seen_width - size * len(str(label.text))
    assert size >= 0.01 * min(seen_width, seen_height)


@given(st.floats(-30.0, 40.0), st.floats(-30.0, 40.0))
def test_camera_outside_the_plan_is_visible(x_m: float, y_m: float) -> None:
    plan = FloorPlan.from_dict(FLAT)
    root = ElementTree.fromstring(plan_svg(plan, Marker(x_m=x_m, y_m=y_m, heading_deg=0.0)))
    left, top, width, height = (float(value) for value in root.attrib["viewBox"].split())
    assert left < x_m < left + width
    assert top < -y_m < top + height
    x_min, y_min, x_max, y_max = plan.bounds_m
    assert left < x_min < x_max < left + width
    assert top < -y_max < -y_min < top + height


def mesh_of(plan: FloorPlan) -> trimesh.Scene:
    return trimesh.load_scene(io.BytesIO(plan_glb(plan)), file_type="glb")


@pytest.mark.parametrize("document", [FLAT, L_ROOM], ids=["flat", "concave"])
def test_mesh_encloses_the_volume_of_the_plan(document: dict) -> None:
    plan = FloorPlan.from_dict(document)
    merged = mesh_of(plan).to_mesh()
    expected = sum(room.area_m2 * room.ceiling_height_m for room in plan.rooms)
    # Faces point inwards, so the signed volume is negative.
    assert math.isclose(-merged.volume, expected, rel_tol=1e-5)
    x_min, y_min, x_max, y_max = plan.bounds_m
    top = float(plan.ceiling_heights_m.max())
    np.testing.assert_allclose(merged.bounds, [[x_min, 0.0, -y_max], [x_max, top, -y_min]], atol=1e-5)


def test_mesh_surfaces_are_separate_and_named() -> None:
    areas = {name: mesh.area for name, mesh in mesh_of(FloorPlan.from_dict(FLAT)).geometry.items()}
    assert math.isclose(areas["1/kitchen/floor"], 12.0, rel_tol=1e-5)
    assert math.isclose(areas["1/kitchen/ceiling"], 12.0, rel_tol=1e-5)
    assert math.isclose(areas["1/kitchen/wall"], 14.0 * 2.4, rel_tol=1e-5)
    assert len(areas) == 6


def test_covariance_ellipse_follows_its_axes() -> None:
    # Standard deviation 0.4 m along 30° from +x towards +y, and 0.1 m across.
    along = np.array([math.cos(math.radians(30.0)), math.sin(math.radians(30.0))])
    covariance = 0.01 * np.eye(2) + (0.16 - 0.01) * np.outer(along, along)
    marker = Marker(x_m=1.5, y_m=2.0, covariance_m2=(covariance[0, 0], covariance[0, 1], covariance[1, 1]))
    root = ElementTree.fromstring(plan_svg(FloorPlan.from_dict(FLAT), marker))
    ellipse = next(root.iter(f"{SVG}ellipse"))
    # √5.991 standard deviations contain 95 % of a bivariate normal distribution.
    assert float(ellipse.attrib["rx"]) == pytest.approx(math.sqrt(5.991) * 0.4, abs=1e-3)
    assert float(ellipse.attrib["ry"]) == pytest.approx(math.sqrt(5.991) * 0.1, abs=1e-3)
    turn = float(ellipse.attrib["transform"].removeprefix("rotate(").removesuffix(")"))
    assert turn % 180.0 == pytest.approx(-30.0 % 180.0, abs=1e-2)


OPEN_FLAT = {
    "ceiling_height_m": 2.5,
    "rooms": [
        {"polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "holes": [[[1, 1], [2, 1], [2, 2]]], "walls": [[[3, 3], [3, 2]]]},
        {"polygon": [[4.2, 0], [8, 0], [8, 3], [4.2, 3]]},
    ],
    "openings": [
        {"kind": "door", "line": [[4.1, 1], [4.1, 1.9]]},
        {"kind": "window", "line": [[1, 0], [2, 0]], "sill_m": 1.0, "head_m": 2.0},
    ],
}


def test_openings_holes_and_inner_walls_are_drawn() -> None:
    root = ElementTree.fromstring(plan_svg(FloorPlan.from_dict(OPEN_FLAT)))
    paths = [(path.get("class"), path.get("d")) for path in root.iter(f"{SVG}path")]
    assert ("walls", "M3.000 -3.000L3.000 -2.000") in paths
    assert [kind for kind, _ in paths if kind in ("door", "window")] == ["door", "door", "window"]
    # The window is drawn at both faces of the outer wall.
    assert ("window", "M1.000 -0.000L2.000 -0.000M2.000 0.120L1.000 0.120") in paths
    polygons = [polygon.attrib for polygon in root.iter(f"{SVG}polygon")]
    assert any(polygon["points"].count(" ") == 2 and polygon["fill"] == "#fff" for polygon in polygons)
    # The doorway passes through the wall.
    assert any("4.000,-1.000" in polygon["points"] and "4.200,-1.000" in polygon["points"] for polygon in polygons)


def test_mesh_has_holes_inner_walls_and_opening_panels() -> None:
    surfaces = mesh_of(FloorPlan.from_dict(OPEN_FLAT)).geometry
    assert surfaces["1/room 1/floor"].area == pytest.approx(11.5, abs=1e-4)
    # Outline 14 m, hole 2 + √2 m, both sides of the inner wall 2 m; 2.5 m high.
    assert surfaces["1/room 1/wall"].area == pytest.approx(2.5 * (16.0 + 2.0 + math.sqrt(2.0)), abs=1e-3)
    assert surfaces["1/room 1/window"].area == pytest.approx(1.0, abs=1e-4)
    assert surfaces["2/room 2/door"].area == pytest.approx(0.9 * 2.05, abs=1e-4)
    assert "2/room 2/window" not in surfaces


DOORS = [
    {"kind": "passage", "line": [[4, 0.5], [4, 1.5]], "head_m": 2.1},
    {"kind": "window", "line": [[7, 0], [8, 0]], "sill_m": 0.9, "head_m": 2.1},
]


def test_layout_has_walls_and_openings(client: httpx.Client) -> None:
    document = FLAT | {"openings": DOORS}
    plan_id = upload(client, document)
    layout = client.get(f"/floorplans/{plan_id}/layout").json()
    plan = FloorPlan.from_dict(document)
    assert layout["floorplan_id"] == plan_id
    assert [room["id"] for room in layout["rooms"]] == [room.id for room in plan.rooms]
    for drawn, room in zip(layout["rooms"], plan.rooms, strict=True):
        np.testing.assert_allclose(drawn["walls_m"], room.walls_m)
        assert drawn["ceiling_height_m"] == room.ceiling_height_m
    kitchen, living = layout["rooms"]
    assert [opening["kind"] for opening in kitchen["openings"]] == ["passage"]
    assert sorted(opening["kind"] for opening in living["openings"]) == ["passage", "window"]
    (window,) = (opening for opening in living["openings"] if opening["kind"] == "window")
    x0, y0, x1, y1 = living["walls_m"][window["wall"]]
    ends = sorted(x0 + share * (x1 - x0) for share in (window["start"], window["end"]))
    assert (y0, y1) == (0.0, 0.0)
    assert ends == pytest.approx([7.0, 8.0])
    assert (window["sill_m"], window["head_m"]) == (0.9, 2.1)
    assert kitchen["openings"][0]["sill_m"] is None


def test_layout_of_older_revision_is_available(client: httpx.Client) -> None:
    plan_id = upload(client)
    first = client.get(f"/floorplans/{plan_id}").json()["revision"]
    client.put(f"/floorplans/{plan_id}", json=FLAT | {"openings": DOORS}).raise_for_status()
    now = client.get(f"/floorplans/{plan_id}/layout")
    assert any(room["openings"] for room in now.json()["rooms"])
    before = client.get(f"/floorplans/{plan_id}/layout", params={"revision": first}).json()
    assert before["revision"] == first
    assert not any(room["openings"] for room in before["rooms"])
    known = {"If-None-Match": now.headers["etag"]}
    assert client.get(f"/floorplans/{plan_id}/layout", headers=known).status_code == 304
    assert_problem(client.get(f"/floorplans/{plan_id}/layout", params={"revision": "0" * 32}), 404, "unknown-revision")
    assert_problem(client.get("/floorplans/none/layout"), 404, "unknown-floorplan")
