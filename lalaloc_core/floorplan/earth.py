"""Anchors: conversion between the plan frame and latitude and longitude (WGS84)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from pyproj import Transformer

# Number of cached projections.
_CACHED = 256


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
        return LocalFrame(self.longitude, self.latitude).to_earth(self._turned(position_m))

    def to_plan(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert longitudes and latitudes (degrees) to positions (m) in the plan frame."""
        east_north = LocalFrame(self.longitude, self.latitude).to_local(lon_lat)
        north = math.radians(self.north_deg)
        # The transpose of the rotation in `_turned`.
        return east_north @ np.array([[math.cos(north), -math.sin(north)], [math.sin(north), math.cos(north)]])

    def true_azimuth_deg(self, position_m: tuple[float, float], azimuth_deg: float) -> float:
        """Convert an azimuth of the plan frame (degrees) to degrees clockwise from true north at a position (m).

        Meridians converge: true north at the position differs from that at the anchor by some 0.01° per kilometre east.
        """
        place = np.array([position_m], dtype=float)
        frame = LocalFrame(self.longitude, self.latitude)
        convergence_deg = frame.convergence_deg(self.to_earth(place)[0])
        return (azimuth_deg - self.north_deg + convergence_deg) % 360.0

    def moved(self, origin_m: tuple[float, float]) -> Anchor:
        """Return the anchor of the same plan with its origin moved to a position (m), its axes unrotated."""
        ((longitude, latitude),) = self.to_earth(np.array([origin_m], dtype=float))
        convergence_deg = LocalFrame(self.longitude, self.latitude).convergence_deg(np.array([longitude, latitude]))
        north_deg = (self.north_deg - convergence_deg) % 360.0
        return Anchor(float(latitude), float(longitude), self.altitude_m, north_deg)

    def _turned(self, position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Rotate positions to metres east and north: north lies `north_deg` clockwise from the plan's +y."""
        north = math.radians(self.north_deg)
        return position_m @ np.array([[math.cos(north), math.sin(north)], [-math.sin(north), math.cos(north)]])


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

    @property
    def anchor(self) -> Anchor:
        """The point as the anchor of a plan whose +y is north."""
        return Anchor(latitude=self.latitude, longitude=self.longitude, north_deg=0.0)


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
