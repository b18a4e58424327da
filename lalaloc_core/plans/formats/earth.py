"""From latitude and longitude to local metres and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pyproj import Transformer

from lalaloc_core.plans.model.sketch import Anchor

Projection = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]


@dataclass(frozen=True)
class LocalFrame:
    """East and north in metres around a place: a transverse Mercator projection through it, true to scale there.

    Within a kilometre of the place lengths are right to a hundred-millionth.
    """

    longitude: float
    latitude: float

    def to_local(self, lon_lat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Metres east and north of the place."""
        return _transform(self._pipeline(), lon_lat, inverse=False)

    def to_earth(self, east_north_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Longitude and latitude (degrees)."""
        return _transform(self._pipeline(), east_north_m, inverse=True)

    @property
    def anchor(self) -> Anchor:
        """The place as the anchor of a plan whose +y is north."""
        return Anchor(latitude=self.latitude, longitude=self.longitude, north_deg=0.0)

    def _pipeline(self) -> Transformer:
        local = f"+proj=tmerc +lat_0={self.latitude!r} +lon_0={self.longitude!r} +k=1 +datum=WGS84 +units=m"
        return Transformer.from_crs("EPSG:4326", local, always_xy=True)


def _transform(pipeline: Transformer, points: Float[np.ndarray, "n 2"], *, inverse: bool) -> Float[np.ndarray, "n 2"]:
    x, y = pipeline.transform(points[:, 0], points[:, 1], direction="INVERSE" if inverse else "FORWARD")
    return np.column_stack([x, y])


def to_wgs84(code: str, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Longitude and latitude of points in the reference system of an authority's code, such as "EPSG:25832".

    Raises:
        ProjError: an unknown code.
    """
    return _transform(Transformer.from_crs(code, "EPSG:4326", always_xy=True), points, inverse=False)
