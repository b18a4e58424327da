"""IFC files, checked before the library computes with them; the place of a model on Earth, and its fixtures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from pyproj.exceptions import ProjError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor, LocalFrame, to_wgs84
from lalaloc_core.floorplan.plan_words import fixture_from_name

# End of a complete file; some tools append white space or comments.
_END, _TAIL_BYTES = b"END-ISO-10303-21", 4096
# Placements in a chain; a model has about ten. Numbers of a hundred digits are beyond all that is measured, and larger
# ones end the reading of their instance.
_MAX_PLACEMENTS = 64
# Schema in the head of a file, and by its beginning the version that is read in its place.
_SCHEMA, _HEAD = re.compile(r"(FILE_SCHEMA\s*\(\s*\(\s*')([^']{0,50})"), 65_536
_SCHEMAS = {"IFC2X3": "IFC2X3", "IFC4X": "IFC4X3_ADD2", "IFC4": "IFC4"}
_LARGE_NUMBER = re.compile(rb"[(,]\s*([-+]?\d+\.?\d*[Ee]\+?\d{3,}|[-+]?\d{101,}\.\d*)\s*[,)]")
# Classes with fixtures among their elements: sanitary terminals are flow terminals, furniture is furnishing.
FURNISHINGS = ("IfcFlowTerminal", "IfcFurnishingElement", "IfcStair", "IfcStairFlight")


def open_model(content: bytes) -> Any:
    """Open a model with ifcopenshell."""
    import ifcopenshell

    if (large := _LARGE_NUMBER.search(content)) is not None:
        raise InvalidFloorPlanError(
            f"the IFC model has the number {large[1][:50].decode('ascii', 'replace')}; the limit is 1.E100; correct "
            "it, and export the model again"
        )
    # ifcopenshell reads a truncated file without an error, and the rest is missing.
    if _END not in content[-_TAIL_BYTES:]:
        raise InvalidFloorPlanError(f"the IFC file is truncated: it does not end with {_END.decode()}; export it again")
    # The format is ASCII and escapes other characters, so nothing is lost by "replace".
    text = content.decode("utf-8", "replace")
    stated = _SCHEMA.search(text, 0, _HEAD)
    schema = stated[2] if stated is not None else ""
    # The library knows one version of each schema.
    known = next((known for start, known in _SCHEMAS.items() if schema.upper().startswith(start)), schema)
    try:
        model = ifcopenshell.file.from_string(_SCHEMA.sub(rf"\g<1>{known}", text, 1) if known != schema else text)
        schema = str(model.schema)
    except (RuntimeError, ValueError, TypeError, AttributeError, OSError) as error:
        raise InvalidFloorPlanError("the IFC model cannot be read: export it again as IFC4") from error
    if not schema.startswith(("IFC2X3", "IFC4")):
        raise InvalidFloorPlanError(f"the model's schema is {schema[:50]}; export it as IFC2X3 or IFC4")
    _check_placements(model)
    return model


def _check_placements(model: Any) -> None:
    """Check that placements are relative to few others, and not to themselves, which the library follows forever."""
    depths: dict[int, int] = {}
    for placement in model.by_type("IfcLocalPlacement"):
        chain: list[int] = []
        while placement is not None and placement.id() not in depths and placement.is_a("IfcLocalPlacement"):
            if placement.id() in chain:
                raise InvalidFloorPlanError(
                    f"the IfcLocalPlacement #{placement.id()} is relative to itself; export the model again"
                )
            chain.append(placement.id())
            placement = None if len(chain) >= _MAX_PLACEMENTS else placement.PlacementRelTo
        depth = 0 if placement is None else depths.get(placement.id(), 0)
        if depth + len(chain) >= _MAX_PLACEMENTS:
            raise InvalidFloorPlanError(
                f"the IfcLocalPlacement #{chain[0]} is relative to more than {_MAX_PLACEMENTS} others in a chain, "
                "the limit; export the model again"
            )
        depths |= {link: depth + len(chain) - index for index, link in enumerate(chain)}


def fixture_kind(element: Any) -> str | None:
    """Return the kind of fixture that an element is, by its class, predefined type and names; None if it is none."""
    if not any(element.is_a(name) for name in FURNISHINGS):
        return None
    if element.is_a("IfcStair") or element.is_a("IfcStairFlight"):
        # A stair without a shape of its own consists of flights.
        return "stairs" if element.Representation is not None else None
    relations = (*(getattr(element, "IsTypedBy", None) or ()), *(getattr(element, "IsDefinedBy", None) or ()))
    types = [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
    parts = (element, *types)
    names = (getattr(part, key, None) for key in ("PredefinedType", "ObjectType", "Name") for part in parts)
    return fixture_from_name(*(str(name or "")[:200] for name in names))


def find_anchor(model: Any, unit: float) -> Anchor | None:
    """Return the place of the model's origin from IfcMapConversion (IFC 4), else from the site's coordinates.

    `unit` is the length of the model's unit (m).
    """
    if (mapped := _map_conversion(model)) is not None:
        return mapped
    north_deg = _true_north_deg(model)
    for site in model.by_type("IfcSite"):
        if site.RefLatitude and site.RefLongitude:
            latitude, longitude = _degrees(site.RefLatitude), _degrees(site.RefLongitude)
            altitude = None if site.RefElevation is None else float(site.RefElevation) * unit
            if abs(latitude) <= 90.0 and abs(longitude) <= 180.0:
                return _at_origin(Anchor(latitude, longitude, altitude, north_deg), site, unit)
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
            lon_lat = to_wgs84(code, np.array([[east, north], [east, north + 100.0]]))
            frame = LocalFrame(*map(float, lon_lat[0]))
            step = frame.to_local(lon_lat[1:])[0]
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


def _at_origin(anchor: Anchor, site: Any, unit: float) -> Anchor:
    """Return the anchor of the model's origin for that of a site, which can be placed elsewhere in the model."""
    from ifcopenshell.util.placement import get_local_placement

    if site.ObjectPlacement is None:
        return anchor
    offset_m = -np.asarray(get_local_placement(site.ObjectPlacement))[:2, 3] * unit
    ((longitude, latitude),) = anchor.to_earth(offset_m[None])
    return replace(anchor, latitude=float(latitude), longitude=float(longitude))
