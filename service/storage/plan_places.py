"""Where plans lie on Earth, and which of them lie near a place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from sqlalchemy import ColumnElement, and_, or_

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor, LocalFrame
from service.storage.tables import FLOORPLANS

# Metres of a degree of latitude, where it has the least.
_DEGREE_M = 110_500.0


def place_columns(plan: FloorPlan) -> dict[str, float | None]:
    """What the table of plans has of where a plan lies: the circle around it, and its centre on Earth."""
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


def lies_in_box(latitude: float, longitude: float, within_m: float) -> ColumnElement[bool]:
    """Plans whose centres may lie so near a place, and some more: those in a box around it."""
    high = within_m / _DEGREE_M
    near = FLOORPLANS.c.latitude.between(latitude - high, latitude + high)
    if abs(latitude) + high >= 89.0:
        # Meridians meet.
        return near
    wide = high / math.cos(math.radians(abs(latitude) + high))
    own = FLOORPLANS.c.longitude
    # The box may reach over the date line.
    return and_(near, or_(*(own.between(longitude + turn - wide, longitude + turn + wide) for turn in (-360, 0, 360))))


def distances_m(
    rows: Sequence[Any], venue_anchor: Anchor | None, latitude: float, longitude: float
) -> Float[np.ndarray, "n"]:
    """How far the circles around plans are from a place, 0 within one; NaN for plans whose place is not known.

    Args:
        rows: with `centre_x_m`, `centre_y_m`, `reach_m`, `latitude` and `longitude` of plans.
        venue_anchor: where plans without an anchor of their own lie.
    """
    lon_lat = np.array([[_number(row.longitude), _number(row.latitude)] for row in rows]).reshape(-1, 2)
    centre = np.array([[_number(row.centre_x_m), _number(row.centre_y_m)] for row in rows]).reshape(-1, 2)
    unknown = np.isnan(lon_lat[:, 0])
    if venue_anchor is not None and unknown.any():
        lon_lat[unknown] = venue_anchor.to_earth(centre[unknown])
    away = LocalFrame(longitude, latitude).to_local(lon_lat)
    reach = np.array([_number(row.reach_m) for row in rows])
    # What cannot be projected is not a number, but infinitely far.
    distance = np.where(np.isnan(lon_lat[:, 0]), np.nan, np.hypot(away[:, 0], away[:, 1]))
    return np.maximum(distance - reach, 0.0)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
