"""Where on Earth a plan lies: anchors, and from latitude and longitude to local metres and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from pyproj import Transformer

# Frames whose projections are kept.
_KEPT = 256


@dataclass(frozen=True)
class Anchor:
    """Where on Earth a plan's origin lies, WGS84; `north_deg` is the azimuth of true north in the plan frame there.

    Attributes:
        altitude_m: of the plan's floor, over the ellipsoid; None when it is not known.
    """

    latitude: float
    longitude: float
    altitude_m: float | None = None
    north_deg: float = 0.0

    def to_earth(self, position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Longitude and latitude (degrees) of positions in the plan frame."""
        return LocalFrame(self.longitude, self.latitude).to_earth(self._turned(position_m))

    def to_plan(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Positions in the plan frame of longitudes and latitudes (degrees)."""
        east_north = LocalFrame(self.longitude, self.latitude).to_local(lon_lat)
        north = math.radians(self.north_deg)
        # The rows are east and north as the plan has them; turning back is the transpose.
        return east_north @ np.array([[math.cos(north), -math.sin(north)], [math.sin(north), math.cos(north)]])

    def true_azimuth_deg(self, position_m: tuple[float, float], azimuth_deg: float) -> float:
        """Degrees clockwise from true north, at a place of the plan, of an azimuth of the plan frame (degrees).

        North is that of the place, which converges on that of the anchor: 0.01° a kilometre to the east.
        """
        place = np.array([position_m], dtype=float)
        frame = LocalFrame(self.longitude, self.latitude)
        convergence_deg = frame.convergence_deg(self.to_earth(place)[0])
        return (azimuth_deg - self.north_deg + convergence_deg) % 360.0

    def moved(self, origin_m: tuple[float, float]) -> Anchor:
        """The anchor of the plan whose origin is a place of this one, its axes unturned."""
        ((longitude, latitude),) = self.to_earth(np.array([origin_m], dtype=float))
        convergence_deg = LocalFrame(self.longitude, self.latitude).convergence_deg(np.array([longitude, latitude]))
        north_deg = (self.north_deg - convergence_deg) % 360.0
        return Anchor(float(latitude), float(longitude), self.altitude_m, north_deg)

    def _turned(self, position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Metres east and north: north lies `north_deg` clockwise from the plan's +y."""
        north = math.radians(self.north_deg)
        return position_m @ np.array([[math.cos(north), math.sin(north)], [-math.sin(north), math.cos(north)]])


@dataclass(frozen=True)
class LocalFrame:
    """East and north in metres around a place: a transverse Mercator projection through it, true to scale there.

    Within a kilometre of the place lengths are right to a hundred-millionth.
    """

    longitude: float
    latitude: float

    def to_local(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Metres east and north of the place."""
        return _transform(_projection(self), lon_lat, inverse=False)

    def to_earth(self, east_north_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Longitude and latitude (degrees)."""
        return _transform(_projection(self), east_north_m, inverse=True)

    def convergence_deg(self, lon_lat: Float[np.ndarray, "2"]) -> float:
        """How far clockwise from true north, at a longitude and latitude (degrees), the frame's north points."""
        longitude, latitude = lon_lat
        span = math.radians(float(longitude) - self.longitude)
        return math.degrees(math.atan(math.tan(span) * math.sin(math.radians(float(latitude)))))

    @property
    def anchor(self) -> Anchor:
        """The place as the anchor of a plan whose +y is north."""
        return Anchor(latitude=self.latitude, longitude=self.longitude, north_deg=0.0)


def to_wgs84(code: str, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Longitude and latitude of points in the reference system of an authority's code, such as "EPSG:25832".

    Raises:
        ProjError: an unknown code.
    """
    from pyproj import Transformer

    return _transform(Transformer.from_crs(code, "EPSG:4326", always_xy=True), points, inverse=False)


@lru_cache(_KEPT)
def _projection(frame: LocalFrame) -> Transformer:
    from pyproj import Transformer

    local = f"+proj=tmerc +lat_0={frame.latitude!r} +lon_0={frame.longitude!r} +k=1 +datum=WGS84 +units=m"
    return Transformer.from_crs("EPSG:4326", local, always_xy=True)


def _transform(pipeline: Transformer, points: Float[np.ndarray, "n 2"], *, inverse: bool) -> Float[np.ndarray, "n 2"]:
    x, y = pipeline.transform(points[:, 0], points[:, 1], direction="INVERSE" if inverse else "FORWARD")
    return np.column_stack([x, y])
