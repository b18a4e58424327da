"""Places of plans at the poles and on the date line: distances to plans, and poses on Earth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyproj
import pytest

from lalaloc_core.floorplan.earth import Anchor
from service.query.geopose import geopose_at
from service.venues.venue_hints import distances_m
from tests.core.test_earth import PLACES

GEOD = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("place", PLACES)
def test_venue_anchor_places_plans_anywhere(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    row = SimpleNamespace(centre_x_m=30.0, centre_y_m=-40.0, reach_m=5.0, latitude=None, longitude=None)
    assert distances_m([row], anchor, anchor.latitude, anchor.longitude) == pytest.approx([45.0], abs=1e-3)


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
