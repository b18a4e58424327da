"""From a grey picture of known scale to rooms and openings, with what is unsure about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import UInt8

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.drawing.walls import Enclosed, Gap, WallConfig, enclose
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.model.sketch import OpeningKind, Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.picture.gaps import GapContent, GapReader
from lalaloc_core.importers.picture.ink import Ink, read_ink
from lalaloc_core.importers.picture.masks import WallMask, bodies_of, dark_walls, outlined_walls, straightened
from lalaloc_core.importers.picture.panes import windows_in_walls

# In pictures windows are gaps in dark walls, and wider than doors; what has no symbol is no opening when it is wide.
_CONFIG = WallConfig(widest_gap=6.0, narrowest_gap=0.4, thinnest=0.04)
_WIDEST_WITH_ONE_LINE_M = 3.6
_MAX_BARE_GAP_M, _MAX_BARE_GAP_AT_A_FACE_M = 1.9, 1.1
_MIN_ROOM_M2 = 0.8
_MAX_ISLAND_M2 = 2.0
# Dark walls are the surer reading: outlines must enclose so much more to be preferred.
_MORE = 1.6
_SURE = 0.85
_COARSE_M = 0.03
_MAX_WALL_THICKNESS_M = 1.2
# Beyond, what stands in an inner wall is glass; and how far beside a wall one looks what lies there.
_WIDEST_DOOR_M, _BESIDE_M = 1.3, 0.25
# Where drawings have colours, glass is blue and wood is brown, by so much of 255.
_COLOURED = 25.0


@dataclass(frozen=True, eq=False)
class _Reading:
    walls: WallMask
    enclosed: Enclosed
    seen: dict[int, GapContent]
    is_dark: bool

    @property
    def area_m2(self) -> float:
        return float(sum(room.area for room in self.enclosed.rooms))


def sketch_picture(
    gray: UInt8[np.ndarray, "h w"],
    metres_per_pixel: float,
    builder: ReportBuilder,
    budget: Budget,
    warmth: UInt8[np.ndarray, "h w"] | None = None,
) -> Sketch:
    """Rooms are what walls enclose; gaps in walls are doors, windows and passages by what is drawn in them. No kind of
    opening is claimed to be shown completely: that is for who has looked at the draft to say.

    Walls are read twice, as what is dark and thick, and as what lies between two lines; the reading that encloses
    more is taken.

    Args:
        gray: rows from the top, 255 is white.
        metres_per_pixel: of the picture.
        warmth: 128 where there is no colour, more towards red, less towards blue; None of a picture in grey.

    Raises:
        InvalidFloorPlanError: walls of a thickness that no house has: the scale is wrong.
    """
    ink = read_ink(gray, metres_per_pixel, warmth)
    budget.check_time()
    readings = [_read(walls, ink, is_dark, budget) for walls, is_dark in _hypotheses(ink) if walls is not None]
    if not readings:
        builder.use("ink", "nothing that could be walls", 1)
        return Sketch()
    best = readings[0]
    for other in readings[1:]:
        if other.area_m2 > _MORE * best.area_m2:
            best = other
    builder.use("ink", "walls", len(shapely.get_parts(best.enclosed.walls)))
    if best.walls.thickness_m > _MAX_WALL_THICKNESS_M:
        raise InvalidFloorPlanError(
            f"the walls would be {best.walls.thickness_m:.2f} m thick at {metres_per_pixel:g} m per pixel, at most "
            f"{_MAX_WALL_THICKNESS_M:g} m are; is the scale right?"
        )
    _tell(best, ink, metres_per_pixel, builder)
    rooms = [SketchedRoom(straightened(_without_islands(room, builder))) for room in best.enclosed.rooms]
    openings = _openings(best, ink, builder)
    if openings:
        builder.unsure.append(
            "openings are drawn, but count for nothing until opening_kinds names the kinds that are shown completely"
        )
    # A door that was taken for a window, or one that was missed, would speak against the right place.
    return Sketch(rooms=rooms, openings=openings, opening_kinds=())


def _hypotheses(ink: Ink) -> Sequence[tuple[WallMask | None, bool]]:
    return (dark_walls(ink), True), (outlined_walls(ink), False)


def _read(walls: WallMask, ink: Ink, is_dark: bool, budget: Budget) -> _Reading:
    reader = GapReader(ink, walls)
    seen: dict[int, GapContent] = {}

    def judge(gap: Gap) -> int | None:
        seen[id(gap)] = found = reader.look(gap)
        widest = _MAX_BARE_GAP_M if gap.is_between_ends else _MAX_BARE_GAP_AT_A_FACE_M
        is_bare = found.kind == "nothing" or (found.kind == "line" and not gap.is_between_ends)
        if is_bare and not (gap.is_sure and gap.width <= widest):
            return None
        if found.kind != "pane" and gap.width > _WIDEST_WITH_ONE_LINE_M:
            return None
        return ("swing", "pane", "line", "nothing").index(found.kind)

    enclosed = enclose(bodies_of(walls, ink), [], (), _CONFIG, budget.check_time, judge)
    rooms = [room for room in enclosed.rooms if room.area >= _MIN_ROOM_M2]
    return _Reading(walls, Enclosed(rooms, enclosed.gaps, enclosed.walls), seen, is_dark)


def _without_islands(room: shapely.Polygon, builder: ReportBuilder) -> shapely.Polygon:
    """Letters and furniture that were taken for walls stand in rooms; so may columns, which are lost with them."""
    small = [ring for ring in room.interiors if shapely.Polygon(ring).area <= _MAX_ISLAND_M2]
    if small:
        builder.unsure.append(f"{len(small)} dark shapes inside a room were taken for furniture, not for columns")
    large = [ring for ring in room.interiors if shapely.Polygon(ring).area > _MAX_ISLAND_M2]
    return shapely.Polygon(room.exterior, large)


def _openings(reading: _Reading, ink: Ink, builder: ReportBuilder) -> list[SketchedOpening]:
    """Gaps by what was seen in them and what lies at their sides, and panes that are drawn into walls."""
    rooms = reading.enclosed.rooms
    outside = shapely.unary_union([room.buffer(0.05) for room in rooms])
    # What leads from nowhere to nowhere is a gap between strokes of something else.
    gaps = [(gap, reading.seen[id(gap)]) for gap in reading.enclosed.gaps if outside.intersects(gap.shape)]
    seen = [(gap.start, gap.end, what) for gap, what in gaps]
    if not reading.is_dark:
        panes = windows_in_walls(reading.walls, ink)
        seen += [(pane.start, pane.end, GapContent("pane", 1.0)) for pane in panes]
    found = []
    for start, end, what in seen:
        width = math.dist(start, end)
        is_inner = _is_between_rooms(start, end, reading.walls.thickness_m, rooms)
        kind = _kind(what, width, is_inner=is_inner)
        found.append(SketchedOpening(kind, start, end))
        if (why := _doubt(what, kind)) is not None:
            where = f"({start[0]:.2f}, {start[1]:.2f})"
            builder.unsure.append(f"a gap of {width:.2f} m at {where} was taken for a {kind}: {why}")
    return found


def _kind(seen: GapContent, width: float, *, is_inner: bool) -> OpeningKind:
    """Doors are drawn without their swing, too: lines in an inner wall are a leaf, those in an outer one panes."""
    if seen.kind == "swing":
        return "door"
    if seen.kind == "nothing":
        return "passage"
    if abs(seen.warmth) >= _COLOURED:
        return "door" if seen.warmth > 0.0 else "window"
    if seen.kind == "line" and is_inner:
        return "passage"
    return "door" if is_inner and width <= _WIDEST_DOOR_M else "window"


def _is_between_rooms(
    start: tuple[float, float], end: tuple[float, float], thickness_m: float, rooms: Sequence[shapely.Polygon]
) -> bool:
    """Whether there is a room at both sides of a gap, be it the same one."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / max(math.dist(start, end), 1e-9)
    across = (0.5 * thickness_m + _BESIDE_M) * np.array([-along[1], along[0]])
    sides = [shapely.Point(0.5 * (a + b) + side * across) for side in (1.0, -1.0)]
    return all(any(room.covers(side) for room in rooms) for side in sides)


def _doubt(seen: GapContent, kind: OpeningKind) -> str | None:
    """Why an opening may be of another kind; None where nothing speaks for that."""
    if seen.kind == "nothing":
        return "nothing is drawn in it"
    if seen.kind == "line":
        return "a single line is drawn in it"
    if seen.kind == "pane" and kind == "door":
        return "it is drawn like a window, but " + ("brown" if seen.warmth >= _COLOURED else "in an inner wall")
    return f"{seen.confidence:.0%} of its symbol is drawn" if seen.confidence < _SURE else None


def _tell(reading: _Reading, ink: Ink, metres_per_pixel: float, builder: ReportBuilder) -> None:
    what = "dark and thick" if reading.is_dark else "drawn with two lines"
    builder.notes.append(f"walls are {what}, usually {reading.walls.thickness_m:.2f} m thick")
    if ink.skew_deg:
        builder.notes.append(f"the picture was turned by {ink.skew_deg:.2f}° to be straight")
    builder.notes.append("lettering is not read: name the rooms")
    if metres_per_pixel > _COARSE_M:
        builder.unsure.append(
            f"a pixel is {100 * metres_per_pixel:.1f} cm, walls are a few pixels thick: a larger picture reads better"
        )
