"""Places of plans at the poles and on the date line: searches for near plans, and poses on Earth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyproj
import pytest

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from service.query.geopose import geopose_at
from service.query.oscp import distance_to_plan_m
from service.schemas import EarthPoint
from service.storage.plan_places import distances_m
from service.storage.records import NewPlan, Original
from service.storage.store import Store
from tests.core.test_earth import PLACES
from tests.service.conftest import FLAT

GEOD = pyproj.Geod(ellps="WGS84")
WITHIN_M = 200.0


def _beside(place: tuple[float, float], azimuth_deg: float, distance_m: float) -> tuple[float, float]:
    longitude, latitude, _ = GEOD.fwd(*place, azimuth_deg, distance_m)
    return longitude, latitude


@pytest.mark.parametrize("place", PLACES)
def test_near_plans_are_found_anywhere(store: Store, place: tuple[float, float]) -> None:
    antipode = ((place[0] + 360.0) % 360.0 - 180.0, -place[1])
    azimuths_deg = [0.0, 90.0, 180.0, 270.0]
    far = [_beside(place, azimuth_deg, 2e4) for azimuth_deg in azimuths_deg]
    for number, (longitude, latitude) in enumerate([place, antipode, *far]):
        anchor = {"longitude": longitude, "latitude": latitude, "north_deg": 0.0}
        plan = FloorPlan.from_dict(FLAT | {"anchor": anchor})
        store.plans.add("default", f"{number:032x}", NewPlan(plan, Original(b"{}")), limit=10)
    for azimuth_deg in azimuths_deg:
        longitude, latitude = _beside(place, azimuth_deg, 150.0)
        rows = store.venues.searchable_plans_near("default", latitude, longitude, WITHIN_M, "model", 0.5)
        found = {row.plan_id: row for row in rows}
        distance_m = distances_m(list(found.values()), None, latitude, longitude)
        near = [plan_id for plan_id, away_m in zip(found, distance_m, strict=True) if away_m <= WITHIN_M]
        assert near == [f"{0:032x}"]
        # Distances are measured to the circle around the plan.
        row, away_m = found[near[0]], distance_m[list(found).index(near[0])]
        assert 150.0 - 2.0 * row.reach_m - 1.0 <= away_m <= 150.0


@pytest.mark.parametrize("place", PLACES)
def test_venue_anchor_places_plans_anywhere(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    row = SimpleNamespace(centre_x_m=30.0, centre_y_m=-40.0, reach_m=5.0, latitude=None, longitude=None)
    assert distances_m([row], anchor, anchor.latitude, anchor.longitude) == pytest.approx([45.0], abs=1e-3)


@pytest.mark.parametrize("place", PLACES)
def test_oscp_distance_holds_anywhere(place: tuple[float, float]) -> None:
    anchor = {"longitude": place[0], "latitude": place[1], "north_deg": 25.0}
    plan = FloorPlan.from_dict(FLAT | {"anchor": anchor})
    for azimuth_deg in (0.0, 90.0, 180.0, 270.0):
        longitude, latitude = _beside(place, azimuth_deg, 100.0)
        away_m = distance_to_plan_m(EarthPoint(latitude=latitude, longitude=longitude), plan)
        assert 80.0 < away_m <= 100.0 + 1e-3


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("heading_deg", [0.0, 123.0, 179.99999, 180.0, 180.00001, 359.99999])
def test_geopose_is_valid_anywhere(place: tuple[float, float], heading_deg: float) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0])
    for position_m in ((0.0, 0.0), (40.0, -30.0), (-40.0, 30.0)):
        pose = geopose_at(anchor, position_m, heading_deg, 1.5)
        assert pose is not None
        distance_m = GEOD.inv(*place, pose.position.lon, pose.position.lat)[2]
        assert distance_m == pytest.approx(np.hypot(*position_m), abs=1e-3)
        assert -180.0 < pose.angles.yaw <= 180.0
