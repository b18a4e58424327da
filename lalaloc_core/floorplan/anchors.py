"""Where on Earth a plan lies, as its document says it: by its origin, or by two places that are known on both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor, LocalFrame
from lalaloc_core.floorplan.rooms import Room
from lalaloc_core.floorplan.values import check_keys, is_number, json_kind, read_number_between

_ORIGIN_KEYS = {"latitude", "longitude", "altitude_m", "north_deg"}
_CONTROL_KEYS = {"control_points", "altitude_m"}
_POINT_KEYS = {"x", "y", "latitude", "longitude"}
_ALTITUDE_M = (-1000.0, 10_000.0)
# Farther from its origin a plan would be drawn out by more than a centimetre.
MAX_FROM_ORIGIN_M = 10_000.0
# Two control points as near as this say nothing of directions, and lengths on both sides agree to this share.
_MIN_APART_M, _MAX_STRETCH = 1.0, 0.02
# What is said of north twice may differ by this much.
_SAME_NORTH_DEG, _SAME_DIRECTION_DEG = 1e-6, 1.0


def read_anchor(raw: Any, north_deg: float | None, rooms: Sequence[Room]) -> Anchor | None:
    """The anchor of a plan, None when it has none.

    Args:
        north_deg: what the plan itself says of north.

    Raises:
        InvalidFloorPlanError: a value that cannot be, control points that do not fit, or a plan far from its origin.
    """
    if raw is None:
        return None
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"anchor must be an object, not {json_kind(raw)}")
    reach_m = max(float(np.abs(room.polygon_m).max()) for room in rooms)
    if reach_m > MAX_FROM_ORIGIN_M:
        raise InvalidFloorPlanError(
            f"the plan reaches {reach_m:.0f} m from its origin, at most {MAX_FROM_ORIGIN_M:.0f} m can be anchored; "
            "move it near its origin"
        )
    altitude_m = raw.get("altitude_m")
    if altitude_m is not None:
        altitude_m = read_number_between(altitude_m, "altitude_m of the anchor", *_ALTITUDE_M, " m")
    if "control_points" in raw:
        check_keys(raw, _CONTROL_KEYS, where="anchor: ")
        anchor = _from_control_points(raw["control_points"], altitude_m)
        if north_deg is not None and _apart_deg(north_deg, anchor.north_deg) > _SAME_DIRECTION_DEG:
            raise InvalidFloorPlanError(
                f"north_deg is {north_deg:g}, the control points of the anchor say {anchor.north_deg:.1f}"
            )
        return anchor
    check_keys(raw, _ORIGIN_KEYS, where="anchor: ")
    own_deg = raw.get("north_deg")
    if own_deg is not None:
        own_deg = read_number_between(own_deg, "north_deg of the anchor", -360.0, 360.0, "")
        if north_deg is not None and _apart_deg(north_deg, own_deg) > _SAME_NORTH_DEG:
            raise InvalidFloorPlanError(f"north_deg is {north_deg:g}, that of the anchor {own_deg:g}: give one of them")
        north_deg = own_deg
    if north_deg is None:
        raise InvalidFloorPlanError("an anchor needs north_deg: which azimuth of the plan is true north")
    latitude, longitude = _place(raw, "anchor")
    return Anchor(latitude, longitude, altitude_m, north_deg % 360.0)


def anchor_document(anchor: Anchor) -> dict[str, float]:
    """An anchor in the native format; which way north is, says the plan."""
    document = {"latitude": anchor.latitude, "longitude": anchor.longitude}
    return document if anchor.altitude_m is None else document | {"altitude_m": anchor.altitude_m}


def _from_control_points(raw: Any, altitude_m: float | None) -> Anchor:
    """The anchor that takes the middle of two places to their middle, and their line to the right direction."""
    if not isinstance(raw, list | tuple) or len(raw) != 2 or not all(isinstance(point, Mapping) for point in raw):
        raise InvalidFloorPlanError("control_points of the anchor must be two of x, y, latitude and longitude")
    places = []
    for index, point in enumerate(raw):
        check_keys(point, _POINT_KEYS, where=f"control point {index}: ")
        if not all(is_number(point.get(key)) for key in ("x", "y")):
            raise InvalidFloorPlanError(f"control point {index} needs numbers x and y, metres of the plan")
        places.append(_place(point, f"control point {index}"))
    reach_m = MAX_FROM_ORIGIN_M
    drawn = np.array([[read_number_between(each[key], key, -reach_m, reach_m, " m") for key in "xy"] for each in raw])
    lon_lat = np.array([[longitude, latitude] for latitude, longitude in places])
    frame = LocalFrame(float(lon_lat[:, 0].mean()), float(lon_lat[:, 1].mean()))
    on_earth = frame.to_local(lon_lat)
    (dx, dy), (east, north) = drawn[1] - drawn[0], on_earth[1] - on_earth[0]
    drawn_m, earth_m = math.hypot(dx, dy), math.hypot(east, north)
    if not min(drawn_m, earth_m) >= _MIN_APART_M:
        raise InvalidFloorPlanError(
            f"the control points lie {min(drawn_m, earth_m):.2f} m apart, at least 1 m is needed"
        )
    if not abs(drawn_m / earth_m - 1.0) <= _MAX_STRETCH:
        raise InvalidFloorPlanError(
            f"the control points lie {drawn_m:.2f} m apart in the plan, {earth_m:.2f} m on Earth; is the scale right?"
        )
    # Azimuth of the line in the plan, less its azimuth from north.
    north_deg = math.degrees(math.atan2(dx, dy) - math.atan2(east, north)) % 360.0
    middle = Anchor(frame.latitude, frame.longitude, altitude_m, north_deg)
    x, y = drawn.mean(axis=0)
    return middle.moved((-float(x), -float(y)))


def _place(raw: Mapping[str, Any], where: str) -> tuple[float, float]:
    return (
        read_number_between(raw.get("latitude"), f"latitude of the {where}", -90.0, 90.0, ""),
        read_number_between(raw.get("longitude"), f"longitude of the {where}", -180.0, 180.0, ""),
    )


def _apart_deg(first: float, second: float) -> float:
    return abs((first - second + 180.0) % 360.0 - 180.0)
