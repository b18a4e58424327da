"""IndoorGML 1.x: cells become rooms, and the boundaries and transitions between them doors.

The floor of a cell is its surface, or the lowest faces of its solid. A transition whose dual is a boundary with a
geometry gives an exact door, another one a door where its line leaves a cell. https://docs.ogc.org/is/19-011r4/19-011r4.html
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.bounded_files import local_name, read_xml
from lalaloc_core.importers.common.geometry import Floor, check_coordinates, find_floor, opening_line, report_floor
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions, to_number
from lalaloc_core.importers.common.opening_placement import WallLines
from lalaloc_core.importers.common.sketch import ROOM_HEIGHT_M, Level, Point, Sketch, SketchedOpening, SketchedRoom

# Kinds of cells: of the core, and of the module for navigation. Doors can be cells as well.
_CELLS = {"CellSpace", "NavigableSpace", "GeneralSpace", "TransferSpace", "TransitionSpace"}
_DOOR_CELLS, _DOOR_BOUNDARIES = {"ConnectionSpace", "AnchorSpace"}, {"ConnectionBoundary", "AnchorBoundary"}
_BOUNDARIES = {"CellSpaceBoundary", "NavigableBoundary", "TransferBoundary"} | _DOOR_BOUNDARIES
# Floors farther apart are levels (m), and solids are higher than this.
_STOREY_M, _FLAT_M = 1.5, 0.1
_USUAL_DOOR_M = 0.9
_MAX_NAMED = 5
_SRS_UNITS = re.compile(r"4326|4979|CRS84", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class _Cell:
    """Cell with its floor, and the height of its ceiling over it if it has a solid."""

    floor: Floor
    height: float | None
    name: str | None
    kind: str | None
    key: str | None


@dataclass(frozen=True, eq=False)
class _Door:
    """Boundary or transition between two cells, seen from above; `is_exact` is False for the line of a transition."""

    shape: BaseGeometry
    low: float
    high: float
    name: str | None
    is_exact: bool


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per storey, lowest first."""
    elements = list(read_xml(content, budget).iter())
    srs = next((found for element in elements if (found := element.get("srsName"))), "")
    if _SRS_UNITS.search(srs):
        raise InvalidFloorPlanError(
            f"the coordinates of the IndoorGML file are degrees ({srs[:100]}); export it in metres, in a projected or "
            "local coordinate system"
        )
    factor = METRES_PER_UNIT[options.units or "m"]
    read_cells = [(element, _cell(element, factor, budget)) for element in elements if local_name(element) in _CELLS]
    cells = [cell for _, cell in read_cells if cell is not None]
    without = [_text(element, "name") or _key(element) or "?" for element, cell in read_cells if cell is None]
    if not cells:
        raise InvalidFloorPlanError(
            "no CellSpace of the IndoorGML file has a geometry with a floor; export cells with cellSpaceGeometry (a "
            "surface or a solid)"
        )
    doors = list(_doors(elements, factor, budget))
    levels = _levels(cells)

    def make(level: Level, members: list[_Cell]) -> ImportedPlan:
        builder = ReportBuilder("indoorgml", factor, "the option units" if options.units else "the format: metres")
        sketch = Sketch(kinds=("door",))
        if len(levels) > 1:
            sketch.level, sketch.name = level, level.name
        if without:
            builder.use("CellSpace", "ignored (no floor)", len(without))
            named = ", ".join(f"'{name}'" for name in without[:_MAX_NAMED])
            builder.warnings.append(f"{len(without)} cells have no geometry with a floor and were left out: {named}")
        for cell in members:
            builder.use(cell.kind or "CellSpace", "rooms")
            is_usual = ROOM_HEIGHT_M[0] <= (cell.height or 0.0) <= ROOM_HEIGHT_M[1]
            height_m = cell.height if is_usual else None
            sketch.rooms += [SketchedRoom(part, cell.name, (), height_m) for part in cell.floor.parts]
            report_floor(f"cell '{cell.name or cell.key}'", cell.floor, builder)
        lowest = level.elevation_m or 0.0
        on_level = [door for door in doors if lowest - _STOREY_M < door.low < lowest + _STOREY_M]
        _add_doors(on_level, lowest, sketch, builder, budget)
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(levels, options, budget, make)


def _cell(element: Element, factor: float, budget: Budget) -> _Cell | None:
    rings = [ring * factor for ring in _rings(element, "cellSpaceGeometry", budget)]
    floor = find_floor(rings, budget.check_time)
    if floor is None or not floor.parts:
        return None
    high = max(float(ring[:, 2].max()) for ring in rings)
    height = high - floor.low_m if high > floor.low_m + floor.rise_m + _FLAT_M else None
    kind = _text(element, "class") or local_name(element)
    return _Cell(floor, height, _text(element, "name"), kind, _key(element))


def _doors(elements: list[Element], factor: float, budget: Budget) -> Iterator[_Door]:
    """Yield the doors: duals of transitions, connection boundaries, cells of doors, and lines of other transitions."""
    boundaries = {_key(element): element for element in elements if local_name(element) in _BOUNDARIES}
    drawn = {key for key, element in boundaries.items() if local_name(element) in _DOOR_BOUNDARIES}
    plain = []
    for element in (element for element in elements if local_name(element) == "Transition"):
        dual = _reference(element, "duality")
        if dual in boundaries and next(_rings(boundaries[dual], "cellSpaceBoundaryGeometry", budget), None) is not None:
            drawn.add(dual)
        else:
            plain.append(element)
    for key in sorted(key for key in drawn if key is not None):
        yield from _door(boundaries[key], "cellSpaceBoundaryGeometry", factor, budget, is_exact=True)
    for element in elements:
        if local_name(element) in _DOOR_CELLS:
            yield from _door(element, "cellSpaceGeometry", factor, budget, is_exact=True)
    for element in plain:
        yield from _door(element, "geometry", factor, budget, is_exact=False)


def _door(element: Element, member: str, factor: float, budget: Budget, *, is_exact: bool) -> Iterator[_Door]:
    rings = [ring * factor for ring in _rings(element, member, budget)]
    if rings:
        points = np.concatenate(rings)
        line = shapely.LineString(points[:, :2])
        shape = line.convex_hull if is_exact else line
        yield _Door(shape, float(points[:, 2].min()), float(points[:, 2].max()), _text(element, "name"), is_exact)


def _add_doors(doors: list[_Door], floor: float, sketch: Sketch, builder: ReportBuilder, budget: Budget) -> None:
    walls = WallLines([room.shape for room in sketch.rooms])
    outlines = shapely.STRtree([room.shape.boundary for room in sketch.rooms])
    assumed = 0
    for door in doors:
        budget.check_time()
        ends: tuple[Point, Point] | None
        if door.is_exact:
            ends = opening_line(door.shape) if door.shape.length > 0.0 else None
        else:
            crossed = outlines.geometries[outlines.query(door.shape, predicate="intersects")]
            points = shapely.get_coordinates(shapely.intersection(crossed, door.shape))
            ends = walls.line_at(shapely.Point(points.mean(axis=0)), _USUAL_DOOR_M) if len(points) else None
            assumed += ends is not None
        builder.use("doors", "door" if ends is not None else "ignored (no place on a wall)")
        if ends is not None:
            head_m = door.high - floor if door.is_exact and door.high > door.low + 1.0 else None
            sketch.openings.append(SketchedOpening("door", *ends, door.name, None, head_m))
    if assumed:
        builder.unsure.append(f"{assumed} doors are transitions without a boundary; {_USUAL_DOOR_M:g} m is assumed")


def _levels(cells: list[_Cell]) -> Mapping[str, tuple[Level, list[_Cell]]]:
    """Return the cells by storey; the ground floor is the storey nearest to zero."""
    storeys: list[list[_Cell]] = []
    for cell in sorted(cells, key=lambda cell: cell.floor.low_m):
        if not storeys or cell.floor.low_m > storeys[-1][0].floor.low_m + _STOREY_M:
            storeys.append([])
        storeys[-1].append(cell)
    ground = min(range(len(storeys)), key=lambda index: abs(storeys[index][0].floor.low_m))
    return {
        str(index): (Level(f"{index - ground}", float(index - ground), members[0].floor.low_m), members)
        for index, members in enumerate(storeys)
    }


def _rings(element: Element, member: str, budget: Budget) -> Iterator[Float[np.ndarray, "n 3"]]:
    """Yield the positions of every outer ring or line in a member of an element, with z 0 where there is none."""
    for part in (part for child in element if local_name(child) == member for part in child.iter()):
        if _is_line(part) and len(points := _positions(part, budget)) >= 2:
            yield points


def _is_line(element: Element) -> bool:
    """Return whether an element is a line, or the outer ring of a face; a solid has an exterior too."""
    kind = local_name(element)
    return kind in ("LineString", "Curve") or (
        kind == "exterior" and any(local_name(child) in ("LinearRing", "Ring") for child in element)
    )


def _positions(element: Element, budget: Budget) -> Float[np.ndarray, "n 3"]:
    found: list[list[float]] = []
    for part in element.iter():
        if local_name(part) not in ("pos", "posList"):
            continue
        values = [to_number(text) for text in (part.text or "").split()]
        if any(map(math.isnan, values)):
            raise InvalidFloorPlanError(
                f"a position in the IndoorGML file is '{(part.text or '').strip()[:50]}'; positions must be numbers"
            )
        size = _dimension(part, values)
        budget.spend(len(values) // size)
        found += [[*values[first : first + size], 0.0][:3] for first in range(0, len(values) - size + 1, size)]
    points = np.array(found, dtype=float).reshape(-1, 3)
    check_coordinates(points, "a position in the IndoorGML file")
    return points


def _dimension(part: Element, values: list[float]) -> int:
    stated = part.get("srsDimension")
    if stated in ("2", "3"):
        return int(stated)
    is_flat = len(values) == 2 if local_name(part) == "pos" else len(values) % 3 != 0
    return 2 if is_flat else 3


def _key(element: Element, attribute: str = "id") -> str | None:
    """Return an attribute of any namespace; None without it."""
    return next((value for name, value in element.attrib.items() if name.rpartition("}")[2] == attribute), None)


def _reference(element: Element, member: str) -> str | None:
    links = (_key(child, "href") for child in element if local_name(child) == member)
    return next((link.removeprefix("#") for link in links if link is not None), None)


def _text(element: Element, member: str) -> str | None:
    found = next((child.text for child in element if local_name(child) == member and child.text), None)
    return None if found is None or not found.strip() else found.strip()[:200]
