"""Plans at the poles and on the date line: anchors, searches for near plans, and headings."""

from __future__ import annotations

import json
import math

import numpy as np
import pyproj
import pytest
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers import import_plan
from lalaloc_core.importers.importing import FORMATS
from tests.strategies import plan_document, present, rectangle

GEOD = pyproj.Geod(ellps="WGS84")
# Longitude and latitude of places where longitudes jump, and of a usual place.
PLACES = [
    (11.5756, 48.1372),
    (180.0, -16.8),
    (-180.0, 65.0),
    (179.99999, 0.0),
    (-179.99995, 71.0),
    (30.0, 89.9998),
    (-120.0, -89.9998),
    (0.0, 90.0),
    (0.0, -90.0),
]
DRAWN = np.array([[-40.0, 12.0], [35.0, -8.0]])


def _distance_m(first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    return GEOD.inv(first[:, 0], first[:, 1], second[:, 0], second[:, 1])[2]


@pytest.mark.parametrize("place", PLACES)
def test_control_points_make_an_anchor_anywhere(place: tuple[float, float]) -> None:
    known = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    points = [
        {"x": x, "y": y, "latitude": float(latitude), "longitude": float(longitude)}
        for (x, y), (longitude, latitude) in zip(DRAWN.tolist(), known.to_earth(DRAWN), strict=True)
    ]
    document = plan_document(rectangle(4.0, 3.0)) | {"anchor": {"control_points": points}}
    found = present(FloorPlan.from_dict(document).anchor)
    corners = np.array([[0.0, 0.0], [4.0, 3.0], [-50.0, 20.0]])
    assert _distance_m(found.to_earth(corners), known.to_earth(corners)).max() < 1e-3


@pytest.mark.parametrize("longitude", [0.0, 90.0, -170.0])
def test_far_control_points_are_refused(longitude: float) -> None:
    points = [
        {"x": 0, "y": 0, "latitude": 5.0, "longitude": 10.0},
        {"x": 50, "y": 0, "latitude": -5.0, "longitude": longitude},
    ]
    with pytest.raises(InvalidFloorPlanError, match="check the scale"):
        FloorPlan.from_dict(plan_document(rectangle(4.0, 3.0)) | {"anchor": {"control_points": points}})


@pytest.mark.parametrize("place", PLACES)
def test_headings_match_geodesy_anywhere(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    # Degrees clockwise from north of the line from the position to a point ahead of it.
    heading_deg, ahead_m = 70.0, 1.0
    step = ahead_m * np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    for position_m in ((80.0, 60.0), (-90.0, -70.0), (3.0, 150.0), (3.0, -150.0)):
        start, end = anchor.to_earth(np.array([position_m, np.array(position_m) + step]))
        expected = GEOD.inv(*start, *end)[0]
        difference = anchor.true_azimuth_deg(position_m, heading_deg) - expected
        # A metre turns meridians noticeably a few metres from a pole.
        assert (difference + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-3 if abs(place[1]) < 80.0 else 1.0)


@pytest.mark.parametrize("place", PLACES)
def test_moved_anchor_maps_the_same_places(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    points = np.array([[3.0, 4.0], [60.0, -20.0]])
    for origin in ((0.0, 80.0), (-70.0, -50.0)):
        moved = anchor.moved(origin)
        assert _distance_m(moved.to_earth(points - origin), anchor.to_earth(points)).max() < 1e-3


@pytest.mark.parametrize("place", PLACES)
def test_geojson_is_read_anywhere(place: tuple[float, float]) -> None:
    plan = FloorPlan.from_dict(
        plan_document(rectangle(4.0, 3.0, corner=(-2.0, -1.5)), rectangle(5.0, 3.0, corner=(2.2, -1.5)))
        | {"anchor": {"longitude": place[0], "latitude": place[1], "north_deg": 0.0}}
    )
    assert plan.anchor is not None
    content = FORMATS["geojson"].call("write", plan.to_dict(), plan.anchor)
    imported = import_plan(content)
    found = imported.plan()
    assert sorted(room.area_m2 for room in found.rooms) == pytest.approx([12.0, 15.0], abs=0.01)
    for room, known in zip(found.rooms, plan.rooms, strict=True):
        middle_m, known_m = (polygon.mean(axis=0)[None] for polygon in (room.polygon_m, known.polygon_m))
        assert _distance_m(present(found.anchor).to_earth(middle_m), plan.anchor.to_earth(known_m))[0] < 0.01


def test_geojson_around_the_earth_is_refused() -> None:
    ring = [[-170.0, 5.0], [170.0, 5.0], [60.0, -5.0], [-60.0, 0.0], [-170.0, 5.0]]
    content = json.dumps({"type": "Polygon", "coordinates": [ring]}).encode()
    with pytest.raises(InvalidFloorPlanError, match="the features span"):
        import_plan(content)
