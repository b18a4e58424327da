"""Places of plans on Earth, and distances to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor, LocalFrame


def place_columns(plan: FloorPlan) -> dict[str, float | None]:
    """Return the columns of a plan's place: the circle around it, and the circle's centre on Earth."""
    x_min, y_min, x_max, y_max = (float(value) for value in plan.bounds_m)
    x_m, y_m = 0.5 * (x_min + x_max), 0.5 * (y_min + y_max)
    columns: dict[str, float | None] = {
        "centre_x_m": x_m,
        "centre_y_m": y_m,
        "reach_m": 0.5 * math.dist((x_min, y_min), (x_max, y_max)),
        "latitude": None,
        "longitude": None,
    }
    if plan.anchor is not None:
        ((longitude, latitude),) = plan.anchor.to_earth(np.array([[x_m, y_m]]))
        columns |= {"latitude": float(latitude), "longitude": float(longitude)}
    return columns


def distances_m(
    rows: Sequence[Any], venue_anchor: Anchor | None, latitude: float, longitude: float
) -> Float[np.ndarray, "n"]:
    """Return the distances (m) from a place to the circles around plans, 0 inside; NaN for plans with an unknown place.

    Args:
        rows: rows with `centre_x_m`, `centre_y_m`, `reach_m`, `latitude` and `longitude`.
        venue_anchor: anchor of plans without their own.
        latitude: latitude (degrees) of the place.
        longitude: longitude (degrees) of the place.
    """
    lon_lat = np.array([[_number(row.longitude), _number(row.latitude)] for row in rows]).reshape(-1, 2)
    centre = np.array([[_number(row.centre_x_m), _number(row.centre_y_m)] for row in rows]).reshape(-1, 2)
    unknown = np.isnan(lon_lat[:, 0])
    if venue_anchor is not None and unknown.any():
        lon_lat[unknown] = venue_anchor.to_earth(centre[unknown])
    away = LocalFrame(longitude, latitude).to_local(lon_lat)
    reach = np.array([_number(row.reach_m) for row in rows])
    # The projection returns NaN beyond its range, which means infinitely far.
    distance = np.where(np.isnan(lon_lat[:, 0]), np.nan, np.hypot(away[:, 0], away[:, 1]))
    return np.maximum(distance - reach, 0.0)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
