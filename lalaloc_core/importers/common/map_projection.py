"""Projection of the coordinates of GeoJSON and OpenStreetMap to metres around the middle of a plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from pyproj.exceptions import ProjError
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor, LocalFrame, to_wgs84
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions

_MAX_REACH_M = 5000.0
# System of WGS84 with the longitude first.
ORDERED = "OGC:CRS84"
# Latitudes beyond this are longitudes. Shares of square corners from which coordinates are in the right order and up to
# which they are not, and cosines of corners that are square, and of those that count.
_MAX_LATITUDE, _SQUARE, _OBLIQUE = 85.0, 0.9, 0.5
_SQUARE_COSINE, _STRAIGHT = 0.05, 0.9


class Projection(NamedTuple):
    """Conversion of coordinates to metres, with the anchor, metres per unit, their source, warnings and guesses."""

    project: Callable[[BaseGeometry], BaseGeometry]
    anchor: Anchor | None
    metres_per_unit: float
    source: str
    warnings: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()


def projection(shapes: Sequence[BaseGeometry], crs: str | None, options: ImportOptions) -> Projection:
    """Return the conversion for the shapes of a file.

    `crs` is the code of the coordinate reference system, None for WGS84 in a probable order.
    """
    is_ordered, crs = crs == ORDERED, None if crs == ORDERED else crs
    points = np.concatenate([shapely.get_coordinates(shape) for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    if options.units is not None:
        factor = METRES_PER_UNIT[options.units]
        factors = np.array([factor, -factor if options.y_axis == "down" else factor])
        return Projection(lambda shape: shapely.transform(shape, lambda xy: factors * xy), None, factor, "option units")

    def convert(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        converted = points if crs is None else to_wgs84(crs, points)
        if not np.isfinite(converted).all():
            raise InvalidFloorPlanError(
                "coordinates lie outside the area of their reference system; check crs, or set units for a drawing"
            )
        return converted

    if crs is not None:
        try:
            low, high = (convert(np.array([corner]))[0] for corner in (low, high))
        except ProjError as error:
            raise InvalidFloorPlanError(f"the crs '{crs}' is unknown or cannot be used; export it in WGS84") from error
    exchanged, why = (False, "") if crs is not None else _order(shapes, low, high)
    if exchanged:
        found = projection([_flipped(shape) for shape in shapes], ORDERED, options)
        warning = f"the positions are latitude and longitude, and were read so: {why}; exchange the two"
        return found._replace(project=lambda shape: found.project(_flipped(shape)), warnings=(warning,))
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
    anchor = Anchor(frame.latitude, frame.longitude)
    source = "longitude and latitude (WGS84)" if crs is None else crs
    return Projection(project, anchor, 1.0, source, unsure=() if is_ordered or not why else (why,))


def _order(shapes: Sequence[BaseGeometry], low: np.ndarray, high: np.ndarray) -> tuple[bool, str]:
    """Return whether positions are latitude and longitude, and the reason, or that it is unknown; "" if it is sure."""
    x, y = np.abs([low, high]).max(axis=0)
    if x > _MAX_LATITUDE or y > 180.0:
        return False, ""
    longitude, latitude = (0.5 * (low + high)).tolist()
    beyond = f"in the order of GeoJSON, longitude first, the latitude would be {latitude:g}°"
    if y > 90.0:
        return True, beyond
    frame, swapped = LocalFrame(longitude, latitude), LocalFrame(latitude, longitude)
    as_stated, exchanged = (
        _square_share([shapely.transform(shape, change) for shape in shapes])
        for change in (frame.to_local, lambda points: swapped.to_local(points[:, ::-1]))
    )
    if as_stated < _OBLIQUE and exchanged > _SQUARE:
        return True, "in the order of GeoJSON, longitude first, the rooms would not be square"
    if exchanged < _OBLIQUE and as_stated > _SQUARE:
        return False, ""
    # Near a pole a plan spans many longitudes, which would be many latitudes.
    if y > _MAX_LATITUDE and np.abs(swapped.to_local(np.array([low, high])[:, ::-1])).max() <= _MAX_REACH_M:
        return True, beyond
    return False, (
        f"the positions are taken for longitude {longitude:.3f}° and latitude {latitude:.3f}°, as GeoJSON orders them; "
        "if the place is wrong and the plan mirrored, exchange the two"
    )


def _flipped(shape: BaseGeometry) -> BaseGeometry:
    return shapely.transform(shape, lambda points: points[:, ::-1])


def _square_share(shapes: Sequence[BaseGeometry]) -> float:
    """Return the share of the corners of polygons that are square, weighted by their sides; NaN without polygons."""
    square = total = 0.0
    for part in shapely.get_parts(shapes):
        if isinstance(part, shapely.Polygon):
            along = np.diff(np.asarray(part.exterior.coords), axis=0)
            length = np.linalg.norm(along, axis=1)
            before, before_length = np.roll(along, 1, axis=0), np.roll(length, 1)
            weight = np.minimum(length, before_length)
            cosine = (along * before).sum(axis=1) / np.maximum(length * before_length, 1e-12)
            turns = np.abs(cosine) < _STRAIGHT
            square += float(weight[turns & (np.abs(cosine) < _SQUARE_COSINE)].sum())
            total += float(weight[turns].sum())
    return square / total if total > 0.0 else math.nan


def _middle(lon_lat: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Return the longitude and latitude of the mean of directions from the Earth's centre."""
    longitude, latitude = np.radians(lon_lat).T
    directions = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    x, y, z = (float(direction.mean()) for direction in directions)
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))
