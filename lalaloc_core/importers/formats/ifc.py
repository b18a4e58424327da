"""IFC 2x3 and IFC 4 models: spaces become rooms, doors and windows openings, and columns holes, for every storey.

ifcopenshell (extra `ifc`) reads the model and computes its geometry in metres.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import role_from_name
from lalaloc_core.importers.common import Budget, ImportOptions, Level, ReportBuilder, Sketch, SketchedRoom
from lalaloc_core.importers.common.assemble import ImportedPlan, NoRoomError, assemble, assemble_levels, without_areas
from lalaloc_core.importers.common.geometry import check_coordinates, find_floor, join_faces, opening_line, report_floor
from lalaloc_core.importers.common.sketch import ROOM_HEIGHT_M, OpeningKind, SketchedFixture, SketchedOpening
from lalaloc_core.importers.formats.ifc_file import FURNISHINGS, find_anchor, fixture_kind, open_model

# Vertices (m, model frame) and triangles.
_Mesh = tuple[Float[np.ndarray, "n 3"], Any]
# Distance of touching spaces, largest distance of spaces that share a wall, and smallest width of a passage.
_TOUCHING_M, _THICK_M, _TOUCHING_PASSAGE_M = 2e-3, 0.6, 0.3
# If more than this share of neighbours touch, spaces reach to the centre lines of their walls.
_MOSTLY = 0.9
# Heights of storeys nearer than this are of one storey (m). Triangles seen from the side have no larger area (m²).
_SAME_STOREY_M, _NO_AREA_M2 = 1.5, 5e-10
_KINDS: Mapping[str, OpeningKind] = {"IfcDoor": "door", "IfcWindow": "window"}
# Share of the time limit after which shapes of fixtures, which can be very detailed, are left out.
_FIXTURES_SHARE = 0.6


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per storey with spaces, lowest first."""
    try:
        return _read(content, options, budget)
    except (InvalidFloorPlanError, RecursionError):
        raise
    # An entity that the file lacks is None, and the library raises errors of all kinds for wrong types.
    except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError, RuntimeError) as error:
        raise InvalidFloorPlanError(
            "the IFC model is damaged: an entity lacks a part, or has one of a wrong type; export it again"
        ) from error


def _read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    budget.spend(content.count(b"=IFC") + content.count(b"= IFC"))
    model = open_model(content)
    budget.check_time()
    meshes = _Meshes(budget)
    storeys = _storeys(model, meshes)
    if not storeys:
        raise InvalidFloorPlanError(
            "the IFC model has no IfcSpace in any storey; export it with rooms (Revit: rooms, ArchiCAD: zones)"
        )
    anchor = find_anchor(model, _unit(model))
    elements, lost = _elements(model, storeys, meshes)

    def make(level: Level, content: tuple[str, list[Any]]) -> ImportedPlan:
        key, spaces = content
        builder = ReportBuilder("ifc", _unit(model), "the model's unit")
        sketch = Sketch(level=level, anchor=anchor, name=level.name)
        sketch.north_deg = None if anchor is None else anchor.north_deg
        floor_m = _add_spaces(spaces, sketch, builder, meshes)
        _add_elements(elements[key], floor_m, sketch, builder, meshes)
        for name, count in (+lost).items():
            builder.use(name, "ignored (not in a storey with spaces)", count)
        if not sketch.rooms:
            raise NoRoomError(
                f"the spaces of level '{level.name}' have no geometry; export spaces as solids, or choose another level"
            )
        sketch.rooms = without_areas(sketch.rooms, builder)
        _join_touching(sketch, builder)
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(storeys, options, budget, make)


def _unit(model: Any) -> float:
    from ifcopenshell.util.unit import calculate_unit_scale

    return float(calculate_unit_scale(model))


def _storeys(model: Any, meshes: _Meshes) -> Mapping[str, tuple[Level, tuple[str, list[Any]]]]:
    """Return the storeys that have spaces, by id, with it and the spaces.

    A space belongs to the storey that it is a part of, else to the one that contains it, else to the one at its height.
    """
    unit = _unit(model)
    places = _places(model)
    spaces: dict[str, list[Any]] = {}
    for space in model.by_type("IfcSpace"):
        storey = _whole(space) or _storey_around(space, model.get_inverse(space))
        key = _storey_at(meshes.of(space), places, places) if storey is None else str(storey.id())
        if key is not None:
            spaces.setdefault(key, []).append(space)
    heights = sorted((_stated_elevation_m(model.by_id(int(key)), unit), int(key)) for key in spaces)
    buildings: defaultdict[Any, list[tuple[float, Any]]] = defaultdict(list)
    for height, number in heights:
        storey = model.by_id(number)
        buildings[_whole(storey, "IfcBuilding")].append((height, storey))
    found = {}
    for building, storeys in buildings.items():
        # The ground floor is the storey nearest to zero.
        ground = min(range(len(storeys)), key=lambda i: abs(storeys[i][0]), default=0)
        for number, (height, storey) in enumerate(storeys, -ground):
            name, key = storey.LongName or storey.Name or f"level {number}", str(storey.id())
            if building is not None and len(buildings) > 1:
                name = f"{building.LongName or building.Name or f'building {building.id()}'}, {name}"
            found[key] = (Level(str(name)[:200], float(number), height), (key, spaces[key]))
    return found


def _places(model: Any) -> dict[str, float]:
    """Return the heights (m) of storeys by id, lowest first; a building without storeys counts as one."""
    unit = _unit(model)
    storeys = model.by_type("IfcBuildingStorey") or model.by_type("IfcBuilding")[:1]
    places = ((_elevation_m(storey, unit), str(storey.id())) for storey in storeys)
    return {key: height for height, key in sorted(places)}


def _whole(element: Any, kind: str = "IfcBuildingStorey") -> Any:
    """Return the storey or building that an element, such as a space inside another space, is a part of, or None."""
    for _ in range(16):
        parents = [relation.RelatingObject for relation in getattr(element, "Decomposes", None) or ()]
        if not parents:
            return None
        element = parents[0]
        if element.is_a(kind):
            return element
    return None


def _storey_around(element: Any, relations: Iterable[Any]) -> Any:
    """Return the storey that contains an element by one of its relations, also in a space; None if none does."""
    for relation in relations:
        place = getattr(relation, "RelatingStructure", None)
        if place is not None and place != element:
            storey = place if place.is_a("IfcBuildingStorey") else _whole(place)
            if storey is not None:
                return storey
    return None


def _add_spaces(spaces: Iterable[Any], sketch: Sketch, builder: ReportBuilder, meshes: _Meshes) -> float:
    """Add rooms and return the median height of their floors (m)."""
    floors = []
    for space in spaces:
        mesh = meshes.of(space)
        name = str(space.LongName or space.Name or "")
        if mesh is None:
            builder.use("IfcSpace", "ignored (no geometry)")
            builder.warnings.append(f"space '{name}' ({space.GlobalId}) has no geometry and was left out")
            continue
        vertices, triangles = mesh
        low, high = float(vertices[:, 2].min()), float(vertices[:, 2].max())
        floor = find_floor(vertices[triangles], meshes.check_time)
        parts = floor.parts if floor is not None else _projection(vertices, triangles)
        if role_from_name(name) == "obstacle":
            sketch.obstacles += parts
            builder.use("IfcSpace", "holes (shafts)")
            continue
        height = high - low
        ceiling = height if ROOM_HEIGHT_M[0] <= height <= ROOM_HEIGHT_M[1] else None
        if ceiling is None:
            builder.warnings.append(
                f"space '{name}' is {height:.2f} m high, outside {ROOM_HEIGHT_M[0]:g} to {ROOM_HEIGHT_M[1]:g} m; "
                "the usual ceiling height is used"
            )
        if floor is not None:
            report_floor(f"space '{name}'", floor, builder)
        sketch.rooms += [SketchedRoom(part, name or None, (), ceiling) for part in parts]
        floors.append(low)
        builder.use("IfcSpace", "rooms")
    return float(np.median(floors)) if floors else 0.0


def _elements(
    model: Any, storeys: Mapping[str, tuple[Level, Any]], meshes: _Meshes
) -> tuple[dict[str, list[Any]], Counter[str]]:
    """Return the doors, windows and columns of the storeys with spaces, and counts of what has no such storey, by kind.

    An element belongs to the storey that contains it or its space. Parts of curtain walls, elements that only fill an
    opening, and elements of storeys without spaces belong to the storey at their height.
    """
    places = _places(model)
    found: dict[str, list[Any]] = {key: [] for key in storeys}
    placed = sum(len(spaces) for _, (_, spaces) in storeys.values())
    lost = Counter({"IfcSpace": len(model.by_type("IfcSpace")) - placed})
    for name in (*_KINDS, "IfcColumn", *FURNISHINGS):
        for element in model.by_type(name):
            if name in FURNISHINGS and (fixture_kind(element) is None or not meshes.has_time_for_fixtures):
                continue
            storey = _storey_around(element, getattr(element, "ContainedInStructure", None) or ())
            key = None if storey is None else str(storey.id())
            if key not in storeys:
                key = _storey_at(_shape(element, meshes), places, storeys)
            if key is None:
                lost[name] += 1
            else:
                found[key].append(element)
    return found, lost


def _storey_at(mesh: _Mesh | None, places: Mapping[str, float], with_spaces: Container[str]) -> str | None:
    """Return the id of the storey that a shape stands in; None without a shape, or if that storey has no spaces."""
    if mesh is None:
        return None
    middle_m = float(np.mean([mesh[0][:, 2].min(), mesh[0][:, 2].max()]))
    below = [key for key, height in places.items() if height <= middle_m]
    found = next((key for key in reversed(below) if key in with_spaces), None)
    # Files can have a storey for rooms and one for structure, with slightly different heights.
    return found if found is not None and places[below[-1]] - places[found] <= _SAME_STOREY_M else None


def _elevation_m(storey: Any, unit: float) -> float:
    from ifcopenshell.util.placement import get_local_placement

    if storey.ObjectPlacement is not None:
        return float(np.asarray(get_local_placement(storey.ObjectPlacement))[2, 3]) * unit
    return _stated_elevation_m(storey, unit)


def _stated_elevation_m(storey: Any, unit: float) -> float:
    # A building, which can stand in for a storey, has none.
    return float(getattr(storey, "Elevation", None) or 0.0) * unit


def _add_elements(elements: list[Any], floor_m: float, sketch: Sketch, builder: ReportBuilder, meshes: _Meshes) -> None:
    """Add the doors, windows and columns of a storey."""
    for element in elements:
        if (fixture := fixture_kind(element)) is not None:
            _add_fixture(element, fixture, sketch, builder, meshes)
            continue
        mesh = _shape(element, meshes)
        kind: OpeningKind | None = next((kind for name, kind in _KINDS.items() if element.is_a(name)), None)
        ends = None if mesh is None or kind is None else opening_line(shapely.MultiPoint(mesh[0][:, :2]).convex_hull)
        if mesh is not None and kind is not None and ends is not None:
            sill, head = float(mesh[0][:, 2].min()) - floor_m, float(mesh[0][:, 2].max()) - floor_m
            name = str(element.Tag or element.Name or "") or None
            sill_m = max(sill, 0.0) if kind == "window" else None
            sketch.openings.append(SketchedOpening(kind, *ends, name, sill_m, head))
        elif kind is None and mesh is not None:
            sketch.obstacles += _projection(*mesh)
        else:
            builder.use(element.is_a(), "ignored (no geometry)")
            builder.warnings.append(
                f"{element.is_a()} '{str(element.Tag or element.Name or '')[:50]}' ({element.GlobalId}) has no "
                "geometry and was left out"
            )
            continue
        builder.use(element.is_a(), kind or "holes")


def _add_fixture(element: Any, kind: str, sketch: Sketch, builder: ReportBuilder, meshes: _Meshes) -> None:
    mesh = meshes.of(element) if meshes.has_time_for_fixtures else None
    outline = None if mesh is None else shapely.minimum_rotated_rectangle(shapely.MultiPoint(mesh[0][:, :2]))
    if isinstance(outline, shapely.Polygon):
        sketch.fixtures.append(SketchedFixture(kind, outline))
        builder.use(element.is_a(), f"fixtures: {kind}")
    else:
        builder.use(element.is_a(), "ignored (no geometry)" if meshes.has_time_for_fixtures else "ignored (no time)")


def _join_touching(sketch: Sketch, builder: ReportBuilder) -> None:
    """Add passages between touching spaces, unless all spaces reach to the centre lines of their walls."""
    shapes = [room.shape for room in sketch.rooms]
    near = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=_THICK_M).T
    pairs = [(shapes[i], shapes[j]) for i, j in near if i < j]
    touching = [(a, b) for a, b in pairs if a.distance(b) < _TOUCHING_M and a.buffer(-_TOUCHING_M).disjoint(b)]
    if len(touching) > _MOSTLY * len(pairs):
        return
    for a, b in touching:
        shared = shapely.intersection(a.boundary.buffer(_TOUCHING_M), b.boundary)
        for part in shapely.get_parts(shapely.simplify(shapely.line_merge(shared), _TOUCHING_M)):
            for start, end in pairwise(part.coords):
                if math.dist(start, end) > _TOUCHING_PASSAGE_M:
                    sketch.openings.append(SketchedOpening("passage", start[:2], end[:2]))
                    builder.use("IfcSpace", "passages between touching spaces")


def _shape(element: Any, meshes: _Meshes) -> _Mesh | None:
    """Return the mesh of the void that an element fills; without a void, its own."""
    voids = [relation.RelatingOpeningElement for relation in getattr(element, "FillsVoids", None) or ()]
    return next((found for void in voids if (found := meshes.of(void)) is not None), None) or meshes.of(element)


class _Meshes:
    """Shapes of elements, computed one by one within the budget.

    A mapped item repeats a whole shape, and its shape can have mapped items itself, so a few lines can multiply to
    billions of faces.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self.check_time = budget.check_time
        self._sizes: dict[int, float] = {}

    @property
    def has_time_for_fixtures(self) -> bool:
        """True while there is time to spare."""
        return self._budget.elapsed_s < _FIXTURES_SHARE * self._budget.limits.max_import_s

    def of(self, element: Any) -> _Mesh | None:
        """Return the vertices (m, model frame) and triangles of an element, None if it has no usable shape."""
        import ifcopenshell.geom

        self._budget.check_time()
        if getattr(element, "Representation", None) is None:
            return None
        if (limit := self._budget.limits.max_entities) < self._size(element.Representation):
            raise InvalidFloorPlanError(
                f"the shape of {element.is_a()} '{str(element.Name or '')[:50]}' has more than {limit} entities "
                "(max_entities) with those of its mapped items, or contains itself; simplify it"
            )
        outlines = {"DIMENSIONALITY": ifcopenshell.ifcopenshell_wrapper.CURVES_SURFACES_AND_SOLIDS}
        # Some programs write the outline of a space alone.
        for more in ({}, outlines) if element.is_a("IfcSpace") else ({},):
            settings = ifcopenshell.geom.settings(USE_WORLD_COORDS=True, **more)
            try:
                geometry: Any = ifcopenshell.geom.create_shape(settings, element).geometry  # type: ignore[union-attr]
            except RuntimeError:
                continue
            vertices = np.array(geometry.verts, dtype=float).reshape(-1, 3)
            triangles = np.array(geometry.faces, dtype=int).reshape(-1, 3)
            check_coordinates(vertices, f"the shape of {element.is_a()} '{str(element.Name or '')[:50]}'")
            if len(triangles):
                return vertices, triangles
            if (mesh := _inside(vertices, np.array(geometry.edges, dtype=int).reshape(-1, 2))) is not None:
                return mesh
        return None

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


def _inside(vertices: Float[np.ndarray, "n 3"], edges: Any) -> _Mesh | None:
    """Return a flat mesh of the area that edges enclose, None without one."""
    area = shapely.build_area(shapely.multilinestrings(vertices[edges][:, :, :2]))
    rings = shapely.get_coordinates(shapely.constrained_delaunay_triangles(area)).reshape(-1, 4, 2)
    corners = rings[:, :3].reshape(-1, 2)
    flat = np.insert(corners, 2, vertices[:, 2].min(), axis=1)
    return (flat, np.arange(len(flat)).reshape(-1, 3)) if len(flat) else None


def _projection(vertices: Float[np.ndarray, "n 3"], triangles: Any) -> list[shapely.Polygon]:
    """Return the area that triangles cover, seen from above."""
    shapes = np.asarray(shapely.polygons(vertices[triangles][:, :, :2]))
    return join_faces(shapes[shapely.area(shapes) > _NO_AREA_M2].tolist())
