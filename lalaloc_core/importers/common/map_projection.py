"""Projection of the coordinates of GeoJSON and OpenStreetMap to metres around the middle of a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from pyproj.exceptions import ProjError
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import LocalFrame, to_wgs84
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions

_MAX_REACH_M = 5000.0


def projection(shapes: Sequence[BaseGeometry], crs: str | None, options: ImportOptions) -> Any:
    """Return the function from file coordinates to metres, the anchor, metres per unit, and the source of the scale.

    `crs` is the code of the coordinate reference system, None for WGS84.
    """
    points = np.concatenate([shapely.get_coordinates(shape) for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    if options.units is not None:
        factor = METRES_PER_UNIT[options.units]
        return _scaling(factor, options), None, factor, "option units"
    if crs is not None:
        try:
            convert = _refuse_infinite(lambda points: to_wgs84(crs, points))
            low, high = (convert(np.array([corner]))[0] for corner in (low, high))
        except ProjError as error:
            raise InvalidFloorPlanError(
                f"the crs '{crs}' is unknown or cannot be used; export the file in WGS84"
            ) from error
    else:
        convert = _refuse_infinite(lambda points: points)
    if not (np.abs([low, high]) <= [180.0, 90.0]).all():
        raise InvalidFloorPlanError(
            f"coordinates reach ({high[0]:g}, {high[1]:g}), outside longitude ±180 and latitude ±90; "
            "if the file is a drawing in metres, set units=m (or mm, cm, in, ft)"
        )
    # The box of a plan across the date line or around a pole is as wide as the Earth.
    is_box = 0.0 <= high[0] - low[0] <= 180.0
    longitude, latitude = 0.5 * (low + high) if is_box else _middle(convert(points))
    frame = LocalFrame(float(round(longitude, 9)), float(round(latitude, 9)))

    def project(shape: BaseGeometry) -> BaseGeometry:
        return shapely.transform(shape, lambda points: frame.to_local(convert(points)))

    reach_m = float(np.abs(frame.to_local(convert(points))).max())
    if not reach_m <= _MAX_REACH_M:
        raise InvalidFloorPlanError(
            f"the features span {2.0 * reach_m:.0f} m; the limit for a plan is {2 * _MAX_REACH_M:g} m; "
            "if the file is a drawing in metres, set units=m (or mm, cm, in, ft)"
        )
    return project, frame.anchor, 1.0, "longitude and latitude (WGS84)" if crs is None else crs


def _middle(lon_lat: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Return the longitude and latitude of the mean of directions from the Earth's centre."""
    longitude, latitude = np.radians(lon_lat).T
    directions = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    x, y, z = (float(direction.mean()) for direction in directions)
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def _refuse_infinite(convert: Any) -> Any:
    def convert_finite(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        converted = convert(points)
        if not np.isfinite(converted).all():
            raise InvalidFloorPlanError(
                "coordinates lie outside the area of their reference system; check crs, or set units for a drawing"
            )
        return converted

    return convert_finite


def _scaling(factor: float, options: ImportOptions) -> Any:
    y_factor = -factor if options.y_axis == "down" else factor
    return lambda shape: shapely.transform(shape, lambda points: points * np.array([factor, y_factor]))
