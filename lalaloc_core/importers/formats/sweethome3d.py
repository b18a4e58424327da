"""Sweet Home 3D: `Home.xml` of a `.sh3d` archive, with lengths in centimetres and y down.

Rooms are the areas that walls enclose, with the names of the rooms drawn in them, and drawn rooms that walls do not
enclose. Format: `HomeXMLHandler` of https://www.sweethome3d.com.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from jaxtyping import Float
from shapely import affinity

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import fixture_from_name, role_from_name
from lalaloc_core.importers.common import Budget, ImportOptions, Level, ReportBuilder, Sketch, SketchedRoom
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.bounded_files import local_name, read_xml
from lalaloc_core.importers.common.geometry import point_xy, polygons_of
from lalaloc_core.importers.common.import_options import to_number
from lalaloc_core.importers.common.sketch import ROOM_HEIGHT_M, OpeningKind, SketchedFixture, SketchedOpening
from lalaloc_core.importers.drawing.enclosed_rooms import Enclosed, enclose

_MEMBER = "Home.xml"
_CM = 0.01
_DEFAULT_HEIGHT_CM = 250.0
# Sills from here on (m) are of windows, for openings whose name is not known.
_WINDOW_SILL_M = 0.3
# Steps of round walls; share of a drawn room or an enclosed area that the other covers if both are one room.
_ARC_STEPS, _SAME = 24, 0.5
_MIN_ROOM_M2 = 0.5


@dataclass
class _Storey:
    level: Level
    height_m: float
    walls: list[Element] = field(default_factory=list)
    rooms: list[Element] = field(default_factory=list)
    pieces: list[Element] = field(default_factory=list)


def read(files: Mapping[str, bytes], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per level of a home."""
    name = next((name for name in files if name.rpartition("/")[2].casefold() == _MEMBER.casefold()), None)
    if name is None:
        raise InvalidFloorPlanError(
            f"the Sweet Home 3D file has no {_MEMBER}; open it in Sweet Home 3D 5.3 or later and save it again"
        )
    root = read_xml(files[name], budget)
    if local_name(root) != "home":
        raise InvalidFloorPlanError(f"the root element of {_MEMBER} is <{local_name(root)[:50]}>; it must be <home>")
    storeys = _storeys(root)
    if not storeys:
        raise InvalidFloorPlanError("the home has no walls and no rooms; draw them in Sweet Home 3D or export the plan")
    compass = next((element for element in root if local_name(element) == "compass"), None)
    north_deg = None if compass is None else math.degrees(_number(compass, "northDirection", 0.0))

    def make(level: Level, storey: _Storey) -> ImportedPlan:
        builder = ReportBuilder("sweethome3d", _CM, "the format: centimetres")
        sketch = Sketch(name=str(root.get("name") or "")[:200].removesuffix(".sh3d") or None, north_deg=north_deg)
        if len(storeys) > 1:
            sketch.level, sketch.name = level, level.name
        _add_rooms(storey, sketch, builder, budget)
        _add_pieces(storey, sketch, builder, budget)
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(storeys, options, budget, make)


def _storeys(root: Element) -> dict[str, tuple[Level, _Storey]]:
    """Return the levels with walls or rooms, by id; a home without levels has one."""
    usual_m = _CM * _number(root, "wallHeight", _DEFAULT_HEIGHT_CM)
    found = {"": _Storey(Level("0", 0.0), usual_m)}
    for number, element in enumerate(child for child in root if local_name(child) == "level"):
        name = str(element.get("name") or f"level {number}")[:200]
        level = Level(name, None, _CM * _number(element, "elevation", 0.0))
        found[str(element.get("id"))] = _Storey(level, _CM * _number(element, "height", 100.0 * usual_m))
    for element in root.iter():
        kind = local_name(element)
        storey = found.get(element.get("level") or "", found[""])
        if kind == "wall":
            storey.walls.append(element)
        elif kind == "room":
            storey.rooms.append(element)
        elif kind in ("doorOrWindow", "pieceOfFurniture") and element.get("visible", "true") != "false":
            storey.pieces.append(element)
    return {key: (storey.level, storey) for key, storey in found.items() if storey.walls or storey.rooms}


def _add_rooms(storey: _Storey, sketch: Sketch, builder: ReportBuilder, budget: Budget) -> None:
    bodies = [body for wall in storey.walls for body in _wall(wall, builder, budget)]
    enclosed = enclose(bodies, [], check_time=budget.check_time) if bodies else Enclosed([], [], shapely.Polygon())
    walls = shapely.union_all(bodies)
    drawn: list[tuple[shapely.Polygon, str | None]] = []
    for room in storey.rooms:
        outline = _CM * np.array([(_number(p, "x"), -_number(p, "y")) for p in room if local_name(p) == "point"])
        budget.spend(len(outline))
        has_area = len(outline) >= 3 and np.isfinite(outline).all()
        parts = polygons_of(shapely.Polygon(outline)) if has_area else []
        builder.use("room", "rooms" if parts else "ignored (no area)")
        drawn += [(part, room.get("name") or None) for part in parts]
    height_m = storey.height_m if ROOM_HEIGHT_M[0] <= storey.height_m <= ROOM_HEIGHT_M[1] else None
    for area in (room for room in enclosed.rooms if room.area >= _MIN_ROOM_M2):
        names = [name for part, name in drawn if shapely.intersection(part, area).area > _SAME * part.area]
        # Several drawn rooms divide an open area.
        if len(names) <= 1:
            sketch.rooms.append(SketchedRoom(area, next(iter(names), None), (), height_m))
    taken = shapely.union_all([room.shape for room in sketch.rooms])
    for part, name in drawn:
        if shapely.intersection(part, taken).area <= _SAME * part.area:
            free = polygons_of(part.difference(walls))
            sketch.rooms += [SketchedRoom(free_part, name, (), height_m) for free_part in free]
    sketch.openings += [SketchedOpening("passage", gap.start, gap.end) for gap in enclosed.gaps]


def _wall(wall: Element, builder: ReportBuilder, budget: Budget) -> list[shapely.Polygon]:
    """Return the body of a wall, also of a round one: its ends lie on a circle with an angle `arcExtent`."""
    start, end = (np.array([_number(wall, f"x{key}"), -_number(wall, f"y{key}")]) * _CM for key in ("Start", "End"))
    thickness_m, arc = _CM * _number(wall, "thickness", 0.0), -_number(wall, "arcExtent", 0.0)
    points = np.array([start, end])
    if 1e-3 < abs(arc) < 2.0 * math.pi and np.any(start != end):
        budget.spend(_ARC_STEPS)
        points = _arc(start, end, arc)
    if not np.isfinite(points).all() or thickness_m <= 0.0 or np.all(start == end):
        builder.use("wall", "ignored (no length or thickness)")
        return []
    builder.use("wall", "walls")
    body = shapely.LineString(points).buffer(0.5 * thickness_m, cap_style="square", join_style="mitre")
    return polygons_of(body)


def _arc(start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], angle: float) -> Float[np.ndarray, "n 2"]:
    """Return the points from `start` to `end` on a circle, counter-clockwise by `angle`."""
    first, last = complex(*start), complex(*end)
    centre = 0.5 * (first + last) + 0.5j * (last - first) / math.tan(0.5 * angle)
    points = centre + (first - centre) * np.exp(1j * np.linspace(0.0, angle, _ARC_STEPS + 1))
    return np.column_stack([points.real, points.imag])


def _add_pieces(storey: _Storey, sketch: Sketch, builder: ReportBuilder, budget: Budget) -> None:
    """Add doors, windows and fixtures."""
    for piece in storey.pieces:
        budget.spend()
        catalogue = str(piece.get("catalogId") or "")[:200].rpartition("#")[2]
        name = str(piece.get("name") or "")[:200]
        box, is_opening = _box(piece), local_name(piece) == "doorOrWindow"
        kind = "stairs" if piece.get("staircaseCutOutShape") else fixture_from_name(catalogue, name)
        if is_opening and box is not None:
            sketch.openings.append(opening := _opening(piece, box, catalogue, name))
            builder.use("doorOrWindow", opening.kind)
        elif is_opening or box is None or kind is None:
            builder.use(local_name(piece), "ignored (no width)" if is_opening else "ignored")
        else:
            sketch.fixtures.append(SketchedFixture(kind, box))
            builder.use("pieceOfFurniture", f"fixtures: {kind}")


def _opening(piece: Element, box: shapely.Polygon, catalogue: str, name: str) -> SketchedOpening:
    sill_m, height_m = _CM * _number(piece, "elevation", 0.0), _CM * _number(piece, "height", 0.0)
    roles = [role for text in (catalogue, name) if (role := role_from_name(text)) in ("door", "window", "passage")]
    usual = "window" if sill_m >= _WINDOW_SILL_M else "door"
    is_passage = "frame" in catalogue.casefold() or "passage" in roles
    kind = cast("OpeningKind", "passage" if is_passage else next(iter(roles), usual))
    # The width runs along the wall, from the first corner to the second.
    a, b, c, d = shapely.get_coordinates(box)[:4]
    start, end = point_xy(0.5 * (a + d)), point_xy(0.5 * (b + c))
    return SketchedOpening(kind, start, end, name or None, sill_m if kind == "window" else None, sill_m + height_m)


def _box(piece: Element) -> shapely.Polygon | None:
    """Return the rectangle of a piece of furniture, which begins along its width; None without an area."""
    width_m, depth_m = _CM * _number(piece, "width", 0.0), _CM * _number(piece, "depth", 0.0)
    x_m, y_m = _CM * _number(piece, "x"), -_CM * _number(piece, "y")
    if width_m <= 0.0 or depth_m <= 0.0 or not np.isfinite([x_m, y_m]).all():
        return None
    corners = 0.5 * np.array([[-width_m, -depth_m], [width_m, -depth_m], [width_m, depth_m], [-width_m, depth_m]])
    turned = affinity.rotate(shapely.Polygon(corners), -_number(piece, "angle", 0.0), (0.0, 0.0), use_radians=True)
    return affinity.translate(turned, x_m, y_m)


def _number(element: Element, key: str, default: float = math.nan) -> float:
    """Return an attribute as a number, or the default if it is missing or none."""
    value = to_number(element.get(key))
    return value if math.isfinite(value) else default
