"""Anchors: conversion between the plan frame and latitude and longitude (WGS84).

A plan states its origin's latitude and longitude, or two control points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import check_keys, is_number, json_kind, read_number_between, read_optional
from lalaloc_core.floorplan.rooms import Room

if TYPE_CHECKING:
    from pyproj import Transformer

# Number of cached projections.
_CACHED = 256
_ORIGIN_KEYS = {"latitude", "longitude", "altitude_m", "north_deg"}
_CONTROL_KEYS = {"control_points", "altitude_m"}
_POINT_KEYS = {"x", "y", "latitude", "longitude"}
_ALTITUDE_M = (-1000.0, 10_000.0)
# Farther from its origin the projection would stretch a plan by more than a centimetre.
MAX_FROM_ORIGIN_M = 10_000.0
# Minimum distance of control points, and largest relative difference of their distances in the plan and on Earth.
_MIN_APART_M, _MAX_STRETCH = 1.0, 0.02
# Largest differences between two statements of north: north_deg of plan and anchor, and north_deg and control points.
_SAME_NORTH_DEG, _SAME_DIRECTION_DEG = 1e-6, 1.0


@dataclass(frozen=True)
class Anchor:
    """Position (WGS84, degrees) of a plan's origin on Earth and the azimuth of true north in the plan frame there.

    `altitude_m` is the height of the plan's floor over the ellipsoid; None if unknown.
    """

    latitude: float
    longitude: float
    altitude_m: float | None = None
    north_deg: float = 0.0

    def to_earth(self, position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert positions (m) in the plan frame to longitudes and latitudes (degrees)."""
        north = math.radians(self.north_deg)
        # North lies `north_deg` clockwise from the plan's +y.
        turn = np.array([[math.cos(north), math.sin(north)], [-math.sin(north), math.cos(north)]])
        return LocalFrame(self.longitude, self.latitude).to_earth(position_m @ turn)

    def to_plan(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert longitudes and latitudes (degrees) to positions (m) in the plan frame."""
        east_north = LocalFrame(self.longitude, self.latitude).to_local(lon_lat)
        north = math.radians(self.north_deg)
        # The transpose of the rotation in `to_earth`.
        return east_north @ np.array([[math.cos(north), -math.sin(north)], [math.sin(north), math.cos(north)]])

    def true_azimuth_deg(self, position_m: tuple[float, float], azimuth_deg: float) -> float:
        """Convert an azimuth of the plan frame (degrees) to degrees clockwise from true north at a position (m).

        Meridians converge: true north at the position differs from that at the anchor by some 0.01° per kilometre east.
        """
        place = np.array([position_m], dtype=float)
        frame = LocalFrame(self.longitude, self.latitude)
        convergence_deg = frame.convergence_deg(self.to_earth(place)[0])
        return (azimuth_deg - self.north_deg + convergence_deg) % 360.0

    def place(self, position_m: tuple[float, float], heading_deg: float | None) -> tuple[float, float, float | None]:
        """Return latitude and longitude of a position (m) in the plan frame, and a heading there from true north."""
        ((longitude, latitude),) = self.to_earth(np.array([position_m], dtype=float)).tolist()
        return latitude, longitude, None if heading_deg is None else self.true_azimuth_deg(position_m, heading_deg)

    def moved(self, origin_m: tuple[float, float]) -> Anchor:
        """Return the anchor of the same plan with its origin moved to a position (m), its axes unrotated."""
        ((longitude, latitude),) = self.to_earth(np.array([origin_m], dtype=float))
        convergence_deg = LocalFrame(self.longitude, self.latitude).convergence_deg(np.array([longitude, latitude]))
        north_deg = (self.north_deg - convergence_deg) % 360.0
        return Anchor(float(latitude), float(longitude), self.altitude_m, north_deg)


@dataclass(frozen=True)
class LocalFrame:
    """Metres east and north of a point: a transverse Mercator projection centred there.

    Lengths within a kilometre of the point are accurate to 1e-8.
    """

    longitude: float
    latitude: float

    def to_local(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert longitudes and latitudes (degrees) to metres east and north of the point."""
        return _transform(_projection(self), lon_lat, inverse=False)

    def to_earth(self, east_north_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert metres east and north to longitudes and latitudes (degrees)."""
        return _transform(_projection(self), east_north_m, inverse=True)

    def convergence_deg(self, lon_lat: Float[np.ndarray, "2"]) -> float:
        """Return the angle clockwise from true north to the frame's north at a longitude and latitude (degrees)."""
        longitude, latitude = lon_lat
        span = math.radians(float(longitude) - self.longitude)
        # `atan2` also holds beyond a pole, where longitudes differ by more than 90°.
        return math.degrees(math.atan2(math.sin(span) * math.sin(math.radians(float(latitude))), math.cos(span)))


def to_wgs84(code: str, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Convert points in the reference system of an authority's code, such as "EPSG:25832", to longitude and latitude.

    Raises:
        ProjError: an unknown code.
    """
    from pyproj import Transformer

    return _transform(Transformer.from_crs(code, "EPSG:4326", always_xy=True), points, inverse=False)


@lru_cache(_CACHED)
def _projection(frame: LocalFrame) -> Transformer:
    from pyproj import Transformer

    local = f"+proj=tmerc +lat_0={frame.latitude!r} +lon_0={frame.longitude!r} +k=1 +datum=WGS84 +units=m"
    return Transformer.from_crs("EPSG:4326", local, always_xy=True)


def _transform(pipeline: Transformer, points: Float[np.ndarray, "n 2"], *, inverse: bool) -> Float[np.ndarray, "n 2"]:
    x, y = pipeline.transform(points[:, 0], points[:, 1], direction="INVERSE" if inverse else "FORWARD")
    return np.column_stack([x, y])


def read_anchor(raw: Any, north_deg: float | None, rooms: Sequence[Room]) -> Anchor | None:
    """Read the anchor of a plan, None if it has none.

    `raw` is the value of the document's `anchor`, and `north_deg` the plan's own, None if it has none.
    """
    if raw is None:
        return None
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"anchor must be an object, not {json_kind(raw)}")
    reach_m = max(float(np.abs(room.polygon_m).max()) for room in rooms)
    if reach_m > MAX_FROM_ORIGIN_M:
        raise InvalidFloorPlanError(
            f"the plan reaches {reach_m:.0f} m from its origin; the limit of anchored plans is "
            f"{MAX_FROM_ORIGIN_M:.0f} m; move it near its origin"
        )
    altitude_m = read_optional(raw.get("altitude_m"), "altitude_m of the anchor", *_ALTITUDE_M, " m")
    if "control_points" in raw:
        check_keys(raw, _CONTROL_KEYS, where="anchor: ")
        anchor = _from_control_points(raw["control_points"], altitude_m)
        if north_deg is not None and _apart_deg(north_deg, anchor.north_deg) > _SAME_DIRECTION_DEG:
            raise InvalidFloorPlanError(
                f"north_deg is {north_deg:g}, but the control points of the anchor give {anchor.north_deg:.1f}; "
                "remove north_deg or correct the control points"
            )
        return anchor
    check_keys(raw, _ORIGIN_KEYS, where="anchor: ")
    own_deg = read_optional(raw.get("north_deg"), "north_deg of the anchor", -360.0, 360.0, "")
    if own_deg is not None:
        if north_deg is not None and _apart_deg(north_deg, own_deg) > _SAME_NORTH_DEG:
            raise InvalidFloorPlanError(
                f"north_deg is {north_deg:g}, but that of the anchor is {own_deg:g}; give one of them"
            )
        north_deg = own_deg
    if north_deg is None:
        raise InvalidFloorPlanError("an anchor needs north_deg, the azimuth of true north in the plan")
    latitude, longitude = _place(raw, "anchor")
    return Anchor(latitude, longitude, altitude_m, north_deg % 360.0)


def anchor_document(anchor: Anchor) -> dict[str, float]:
    """Return an anchor in the native format, without north, which the plan states."""
    document = {"latitude": anchor.latitude, "longitude": anchor.longitude}
    return document if anchor.altitude_m is None else document | {"altitude_m": anchor.altitude_m}


def _from_control_points(raw: Any, altitude_m: float | None) -> Anchor:
    """Return the anchor that maps the midpoint of two control points and the direction between them correctly."""
    if not isinstance(raw, list | tuple) or len(raw) != 2 or not all(isinstance(point, Mapping) for point in raw):
        raise InvalidFloorPlanError(
            "control_points of the anchor must be two objects with x, y, latitude and longitude"
        )
    places = []
    for index, point in enumerate(raw):
        check_keys(point, _POINT_KEYS, where=f"control point {index}: ")
        if not all(is_number(point.get(key)) for key in ("x", "y")):
            raise InvalidFloorPlanError(f"control point {index} needs numbers x and y, in metres of the plan")
        places.append(_place(point, f"control point {index}"))
    reach_m = MAX_FROM_ORIGIN_M
    drawn = np.array([[read_number_between(point[key], key, -reach_m, reach_m, " m") for key in "xy"] for point in raw])
    lon_lat = np.array([[longitude, latitude] for latitude, longitude in places])
    (dx, dy), (east, north) = drawn[1] - drawn[0], _frame_at(lon_lat[0]).to_local(lon_lat[1:])[0]
    drawn_m, earth_m = math.hypot(dx, dy), math.hypot(east, north)
    if not min(drawn_m, earth_m) >= _MIN_APART_M:
        raise InvalidFloorPlanError(
            f"the control points are {min(drawn_m, earth_m):.2f} m apart; the minimum is {_MIN_APART_M:g} m"
        )
    if not abs(drawn_m / earth_m - 1.0) <= _MAX_STRETCH:
        raise InvalidFloorPlanError(
            f"the control points are {drawn_m:.2f} m apart in the plan and {earth_m:.2f} m on Earth; the limit is "
            f"{_MAX_STRETCH:.0%} difference; check the scale"
        )
    # Longitudes have no mean at a pole or across the date line, so the midpoint is that of metres.
    frame = _frame_at(_frame_at(lon_lat[0]).to_earth(np.array([[0.5 * east, 0.5 * north]]))[0])
    start, end = frame.to_local(lon_lat)
    east, north = end - start
    # Azimuth of the line in the plan, minus its azimuth from north.
    north_deg = math.degrees(math.atan2(dx, dy) - math.atan2(east, north)) % 360.0
    middle = Anchor(frame.latitude, frame.longitude, altitude_m, north_deg)
    x, y = drawn.mean(axis=0)
    return middle.moved((-float(x), -float(y)))


def _frame_at(lon_lat: Float[np.ndarray, "2"]) -> LocalFrame:
    return LocalFrame(float(lon_lat[0]), float(lon_lat[1]))


def _place(raw: Mapping[str, Any], where: str) -> tuple[float, float]:
    return (
        read_number_between(raw.get("latitude"), f"latitude of the {where}", -90.0, 90.0, ""),
        read_number_between(raw.get("longitude"), f"longitude of the {where}", -180.0, 180.0, ""),
    )


def _apart_deg(first: float, second: float) -> float:
    return abs((first - second + 180.0) % 360.0 - 180.0)
