"""Place of an IFC model on Earth."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from pyproj.exceptions import ProjError

from lalaloc_core.floorplan.earth import Anchor, LocalFrame, to_wgs84


def find_anchor(model: Any, unit: float) -> Anchor | None:
    """Return the place of the model's origin from IfcMapConversion (IFC 4), else from the site's coordinates.

    `unit` is the length of the model's unit (m).
    """
    mapped = _map_conversion(model)
    if mapped is not None:
        return mapped
    north_deg = _true_north_deg(model)
    for site in model.by_type("IfcSite"):
        if not site.RefLatitude or not site.RefLongitude:
            continue
        latitude, longitude = _degrees(site.RefLatitude), _degrees(site.RefLongitude)
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            continue
        latitude, longitude = _origin_from_site(site, latitude, longitude, north_deg, unit)
        altitude = None if site.RefElevation is None else float(site.RefElevation) * unit
        return Anchor(latitude, longitude, altitude, north_deg)
    return None


def _map_conversion(model: Any) -> Anchor | None:
    conversions = model.by_type("IfcMapConversion") if str(model.schema).startswith("IFC4") else []
    for conversion in conversions:
        code = str(getattr(conversion.TargetCRS, "Name", "") or "").upper().replace(" ", "")
        if not code.startswith("EPSG:"):
            continue
        east, north = float(conversion.Eastings), float(conversion.Northings)
        try:
            # A step along grid north gives the angle between grid north and true north.
            lon_lat = to_wgs84(code, np.array([[east, north]]))
            frame = LocalFrame(float(lon_lat[0, 0]), float(lon_lat[0, 1]))
            step = frame.to_local(to_wgs84(code, np.array([[east, north + 100.0]])))[0]
        except ProjError:
            continue
        if not np.isfinite(step).all():
            continue
        grid_north_deg = math.degrees(math.atan2(step[0], step[1]))
        x, y = float(conversion.XAxisAbscissa or 1.0), float(conversion.XAxisOrdinate or 0.0)
        # The model's x axis points along (x, y) of the grid: grid north lies this angle clockwise from its y axis.
        turned_deg = math.degrees(math.atan2(y, x))
        height = float(conversion.OrthogonalHeight or 0.0)
        return Anchor(frame.latitude, frame.longitude, height, (turned_deg - grid_north_deg) % 360.0)
    return None


def _true_north_deg(model: Any) -> float:
    for context in model.by_type("IfcGeometricRepresentationContext", include_subtypes=False):
        direction = context.TrueNorth
        if direction is not None and len(direction.DirectionRatios) >= 2:
            x, y = (float(ratio) for ratio in direction.DirectionRatios[:2])
            if x or y:
                return math.degrees(math.atan2(x, y)) % 360.0
    return 0.0


def _degrees(angle: Iterable[int]) -> float:
    """Convert a compound angle (degrees, minutes, seconds, millionths of a second, all of one sign) to degrees."""
    parts = [float(part) for part in angle]
    return sum(part / size for part, size in zip(parts, (1.0, 60.0, 3600.0, 3600e6), strict=False))


def _origin_from_site(
    site: Any, latitude: float, longitude: float, north_deg: float, unit: float
) -> tuple[float, float]:
    """Return latitude and longitude of the model's origin if the site is placed elsewhere in the model."""
    from ifcopenshell.util.placement import get_local_placement

    if site.ObjectPlacement is None:
        return latitude, longitude
    offset = -np.asarray(get_local_placement(site.ObjectPlacement))[:2, 3] * unit
    turn = math.radians(north_deg)
    # North lies `north_deg` clockwise from +y of the plan.
    north = offset @ np.array([math.sin(turn), math.cos(turn)])
    east = offset @ np.array([math.cos(turn), -math.sin(turn)])
    origin = LocalFrame(longitude, latitude).to_earth(np.array([[east, north]]))[0]
    return float(origin[1]), float(origin[0])
