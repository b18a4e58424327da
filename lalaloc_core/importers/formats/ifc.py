"""IFC 2x3 and IFC 4 models: spaces become rooms, doors and windows openings, and columns holes, for every storey.

ifcopenshell (extra `ifc`) reads the model and computes its geometry in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from pyproj.exceptions import ProjError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor, LocalFrame, to_wgs84
from lalaloc_core.importers.common.assemble import ImportedPlan, NoRoomError, assemble, assemble_levels
from lalaloc_core.importers.common.geometry import opening_line, polygons_from_geometry
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_options import ImportOptions
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import Level, OpeningKind, Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.common.vocabulary import role_from_name

# Faces up to this height above the lowest point of a space are its floor.
_FLOOR_M = 0.05
_HEIGHT_M = (1.0, 20.0)
# Rounding gaps between the triangles of a space that are closed.
_SEAM_M = 1e-4
# Distance of touching spaces, largest distance of spaces that share a wall, and smallest width of a passage.
_TOUCHING_M, _THICK_M, _TOUCHING_PASSAGE_M = 2e-3, 0.6, 0.3
# If more than this share of neighbours touch, spaces reach to the centre lines of their walls.
_MOSTLY = 0.9
# End of a complete file; some tools append white space or comments.
_END, _TAIL_BYTES = b"END-ISO-10303-21", 4096
_KINDS = {"IfcDoor": "door", "IfcWindow": "window"}


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per storey with spaces, lowest first.

    Raises:
        InvalidFloorPlanError: the model is invalid or has no spaces.
        ModuleNotFoundError: ifcopenshell is not installed.
    """
    budget.spend(content.count(b"=IFC") + content.count(b"= IFC"))
    model = _open(content)
    budget.check_time()
    storeys = _storeys(model)
    if not storeys:
        raise InvalidFloorPlanError(
            "the IFC model has no IfcSpace in any storey; export it with rooms (Revit: rooms, ArchiCAD: zones)"
        )
    anchor = _anchor(model)
    meshes = _Meshes(budget)

    def make(level: Level, content: tuple[Any, list[Any]]) -> ImportedPlan:
        storey, spaces = content
        builder = ReportBuilder("ifc", _unit(model), "the model's unit")
        sketch = Sketch(level=level, anchor=anchor, name=level.name)
        sketch.north_deg = None if anchor is None else anchor.north_deg
        floor_m = _add_spaces(spaces, sketch, builder, meshes)
        _add_elements(storey, floor_m, sketch, builder, meshes)
        if not sketch.rooms:
            raise NoRoomError(
                f"the spaces of level '{level.name}' have no geometry; export spaces as solids, or choose another level"
            )
        _join_touching(sketch, builder)
        kinds = {opening.kind for opening in sketch.openings}
        sketch.opening_kinds = tuple(kind for kind in ("door", "window", "passage") if kind in kinds)
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(storeys, options, budget.limits, make)


def _open(content: bytes) -> Any:
    import ifcopenshell

    # ifcopenshell reads a truncated file without an error, and the rest is missing.
    if _END not in content[-_TAIL_BYTES:]:
        raise InvalidFloorPlanError(
            f"the IFC file is truncated: it does not end with {_END.decode()}; export or upload it again"
        )
    try:
        # The format is ASCII and escapes other characters, so nothing is lost by "replace".
        model = ifcopenshell.file.from_string(content.decode("utf-8", "replace"))
        schema = str(model.schema)
    except (RuntimeError, ValueError, TypeError, AttributeError, OSError) as error:
        raise InvalidFloorPlanError(f"the IFC model cannot be read: {error}; export it again as IFC4") from error
    if not schema.startswith(("IFC2X3", "IFC4")):
        raise InvalidFloorPlanError(f"the model's schema is {schema[:50]}; export it as IFC2X3 or IFC4")
    return model


def _unit(model: Any) -> float:
    from ifcopenshell.util.unit import calculate_unit_scale

    return float(calculate_unit_scale(model))


def _storeys(model: Any) -> Mapping[str, tuple[Level, tuple[Any, list[Any]]]]:
    """Return the storeys that have spaces, by id."""
    spaces: dict[int, list[Any]] = {}
    for space in model.by_type("IfcSpace"):
        storey = _storey_of(space)
        if storey is not None:
            spaces.setdefault(storey.id(), []).append(space)
    unit = _unit(model)
    heights = sorted(
        (float(storey.Elevation or 0.0) * unit, storey.id()) for storey in model.by_type("IfcBuildingStorey")
    )
    with_rooms = [(height, key) for height, key in heights if key in spaces]
    # The ground floor is the storey nearest to zero.
    ground = min(range(len(with_rooms)), key=lambda i: abs(with_rooms[i][0]), default=0)
    found = {}
    for number, (height, key) in enumerate(with_rooms):
        storey = model.by_id(key)
        name = str(storey.LongName or storey.Name or f"level {number - ground}")[:200]
        found[str(key)] = (Level(name, float(number - ground), height), (storey, spaces[key]))
    return found


def _storey_of(element: Any) -> Any:
    """Return the storey of an element, also of a space inside another space; None if it has none."""
    for _ in range(16):
        parents = [relation.RelatingObject for relation in getattr(element, "Decomposes", None) or ()]
        if not parents:
            return None
        element = parents[0]
        if element.is_a("IfcBuildingStorey"):
            return element
    return None


def _add_spaces(spaces: Iterable[Any], sketch: Sketch, builder: ReportBuilder, meshes: _Meshes) -> float:
    """Add rooms and return the median height of their floors (m)."""
    floors = []
    for space in spaces:
        mesh = meshes.of(space)
        if mesh is None:
            builder.use("IfcSpace", "ignored (no geometry)")
            continue
        vertices, triangles = mesh
        low, high = float(vertices[:, 2].min()), float(vertices[:, 2].max())
        parts = _footprint(vertices, triangles, low)
        name = str(space.LongName or space.Name or "")
        if role_from_name(name) == "obstacle":
            sketch.obstacles += parts
            builder.use("IfcSpace", "holes (shafts)")
            continue
        height = high - low
        ceiling = height if _HEIGHT_M[0] <= height <= _HEIGHT_M[1] else None
        if ceiling is None:
            builder.warnings.append(
                f"space '{name}' is {height:.2f} m high, outside {_HEIGHT_M[0]:g} to {_HEIGHT_M[1]:g} m; "
                "the usual ceiling height is used"
            )
        sketch.rooms += [SketchedRoom(part, name or None, None, ceiling) for part in parts]
        floors.append(low)
        builder.use("IfcSpace", "rooms")
    return float(np.median(floors)) if floors else 0.0


def _add_elements(storey: Any, floor_m: float, sketch: Sketch, builder: ReportBuilder, meshes: _Meshes) -> None:
    """Add the doors, windows and columns of a storey."""
    for relation in getattr(storey, "ContainsElements", None) or ():
        for element in relation.RelatedElements:
            kind = next((kind for name, kind in _KINDS.items() if element.is_a(name)), None)
            if kind is not None:
                opening = _opening(element, kind, floor_m, meshes)  # type: ignore[arg-type]
                builder.use(element.is_a(), kind if opening is not None else "ignored (no geometry)")
                if opening is not None:
                    sketch.openings.append(opening)
            elif element.is_a("IfcColumn"):
                mesh = meshes.of(element)
                builder.use("IfcColumn", "holes" if mesh is not None else "ignored (no geometry)")
                if mesh is not None:
                    sketch.obstacles += _projection(*mesh)


def _join_touching(sketch: Sketch, builder: ReportBuilder) -> None:
    """Add passages between touching spaces, unless all spaces reach to the centre lines of their walls."""
    shapes = [room.shape for room in sketch.rooms]
    tree = shapely.STRtree(shapes)
    first, second = tree.query(shapes, predicate="dwithin", distance=_THICK_M)
    pairs = [(int(i), int(j)) for i, j in zip(first, second, strict=True) if i < j]
    touching = [(i, j) for i, j in pairs if shapes[i].distance(shapes[j]) < _TOUCHING_M]
    if len(touching) > _MOSTLY * len(pairs):
        return
    for i, j in touching:
        shared = shapely.intersection(shapes[i].boundary.buffer(_TOUCHING_M), shapes[j].boundary)
        for part in shapely.get_parts(shapely.simplify(shapely.line_merge(shared), _TOUCHING_M)):
            for start, end in pairwise(part.coords):
                if math.dist(start, end) > _TOUCHING_PASSAGE_M:
                    sketch.openings.append(SketchedOpening("passage", start[:2], end[:2]))
                    builder.use("IfcSpace", "passages between touching spaces")


def _opening(element: Any, kind: OpeningKind, floor_m: float, meshes: _Meshes) -> SketchedOpening | None:
    """Locate a door or window by the void that it fills; without a void, by its own shape."""
    voids = [relation.RelatingOpeningElement for relation in getattr(element, "FillsVoids", None) or ()]
    mesh = next((found for void in voids if (found := meshes.of(void)) is not None), None) or meshes.of(element)
    if mesh is None:
        return None
    vertices, _ = mesh
    ends = opening_line(shapely.MultiPoint(vertices[:, :2]).convex_hull)
    if ends is None:
        return None
    sill, head = float(vertices[:, 2].min()) - floor_m, float(vertices[:, 2].max()) - floor_m
    name = str(element.Tag or element.Name or "") or None
    return SketchedOpening(kind, *ends, name, max(sill, 0.0) if kind == "window" else None, head)


class _Meshes:
    """Shapes of elements, computed one by one within the budget.

    A mapped item repeats a whole shape, and its shape can have mapped items itself, so a few lines can multiply to
    billions of faces.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._sizes: dict[int, float] = {}

    def of(self, element: Any) -> tuple[Float[np.ndarray, "n 3"], Any] | None:
        """Return the vertices (m, model frame) and triangles of an element, None if it has no usable shape.

        Raises:
            InvalidFloorPlanError: the shape has more than `max_entities` parts, or the time is over.
        """
        import ifcopenshell.geom

        self._budget.check_time()
        if getattr(element, "Representation", None) is None:
            return None
        if (limit := self._budget.limits.max_entities) < self._size(element.Representation):
            raise InvalidFloorPlanError(
                f"the shape of {element.is_a()} '{str(element.Name or '')[:50]}' has more than {limit} entities "
                "(max_entities) with those of its mapped items, or contains itself; simplify it"
            )
        settings = ifcopenshell.geom.settings()
        settings.set("use-world-coords", True)
        try:
            shape = ifcopenshell.geom.create_shape(settings, element)
        except RuntimeError:
            return None
        vertices = np.array(shape.geometry.verts, dtype=float).reshape(-1, 3)  # type: ignore[union-attr]
        triangles = np.array(shape.geometry.faces, dtype=int).reshape(-1, 3)  # type: ignore[union-attr]
        if not len(triangles) or not np.isfinite(vertices).all():
            return None
        return vertices, triangles

    def _size(self, value: Any) -> float:
        """Count an entity and all that it refers to, repeated as often as referred to; infinite for a cycle."""
        if isinstance(value, tuple):
            return sum((self._size(part) for part in value), 0.0)
        if not hasattr(value, "is_a"):
            return 0.0
        key = value.id()
        if key not in self._sizes:
            self._budget.check_time()
            self._sizes[key] = math.inf
            self._sizes[key] = sum((self._size(attribute) for attribute in value), 1.0)
        return self._sizes[key]


def _footprint(vertices: Float[np.ndarray, "n 3"], triangles: Any, low: float) -> list[shapely.Polygon]:
    """Return the floor of a space: its bottom faces, or its whole projection if the bottom is not level."""
    at_bottom = (vertices[triangles][:, :, 2] <= low + _FLOOR_M).all(axis=1)
    floor = _projection(vertices, triangles[at_bottom]) if at_bottom.any() else []
    return floor or _projection(vertices, triangles)


def _projection(vertices: Float[np.ndarray, "n 3"], triangles: Any) -> list[shapely.Polygon]:
    """Return the area that triangles cover, seen from above."""
    corners = vertices[triangles][:, :, :2]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 1e-9
    if not flat.any():
        return []
    seamed = [shapely.Polygon(triangle).buffer(_SEAM_M, join_style="mitre") for triangle in corners[flat]]
    union = shapely.unary_union(seamed)
    return polygons_from_geometry(union.buffer(-_SEAM_M, join_style="mitre"))


def _anchor(model: Any) -> Anchor | None:
    """Return the place of the model's origin from IfcMapConversion (IFC 4), else from the site's coordinates."""
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
        latitude, longitude = _origin_from_site(site, latitude, longitude, north_deg, _unit(model))
        altitude = None if site.RefElevation is None else float(site.RefElevation) * _unit(model)
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
