"""Annotated photographs of real rooms: what can be measured of a camera whose place in a building nobody knows.

    ROOT/<name>.json   the outline of the room around the camera, in camera heights, and what is in its walls
    ROOT/<name>.jpg    the panorama, named in the annotation

docs/reference/datasets.md has the format. A photograph stays the same when room and camera height grow together, so lengths are
read for a camera `CAMERA_HEIGHT_M` over the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import shapely
from jaxtyping import Float, Int
from PIL import Image, UnidentifiedImageError

from lalaloc_core.conventions import OPENING_CLASSES, TWO_PI, wrap_angle
from lalaloc_core.errors import DatasetError, InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.data.assembly import inside, is_number, read_json
from lalaloc_core.learn.data.drawn_openings import DrawnOpening
from lalaloc_core.learn.data.drawn_rooms import DrawnRoom, plan_of_rooms
from lalaloc_core.learn.data.photographs import FilePhotograph
from lalaloc_core.render.profile import nearest_walls, wall_profile

CAMERA_HEIGHT_M = 1.5
# Where a ceiling is not flat: how far over the camera it is taken to be, in camera heights.
_USUAL_CEILING = 1.2
Quality = Literal["good", "fair", "poor"]
# A kind of opening, and the columns of its left and right edge as shares of the picture's width; the left one is the
# larger where the picture's border lies between.
ClassSpan = tuple[str, float, float]

_REQUIRED = {"photograph", "quality", "polygon", "ceiling_above_camera", "openings"}
_OPTIONAL = {"alternative_polygon", "room_type", "notes"}
_OPENING_KEYS = {"kind", "columns", "line"}
_MAX_VERTICES, _MAX_OPENINGS = 200, 100
# In camera heights: the largest coordinate, and how far off the outline the ends of an opening may be drawn.
_MAX_REACH, _OFF_THE_WALL = 60.0, 0.1
# An opening's columns and its line say the same twice; they may differ by this share of the picture's width.
_COLUMN_TOLERANCE = 0.01
# An opening is looked for with so many rays between its edges. It is on a wall that at least so many of them meet, and
# it is that of another outline where it is met within this (m) of the same place.
_RAYS, _MIN_SHARE, _SAME_PLACE_M = 64, 0.2, 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class AnnotatedPhotograph:
    """One photograph and what was drawn on it; metres, camera at (0, 0), +y along the picture's centre column.

    Attributes:
        outlines: the room, and, where another outline can be defended as well, that one.
        has_flat_ceiling: whether the outlines' ceiling height was seen; else it is a usual one.
        class_spans: the openings as they are seen.
    """

    name: str
    photograph: FilePhotograph
    quality: Quality
    outlines: tuple[DrawnRoom, ...]
    has_flat_ceiling: bool
    class_spans: tuple[ClassSpan, ...]
    notes: str = ""

    @property
    def counts(self) -> bool:
        """Whether it is good enough for figures."""
        return self.quality != "poor"

    def profile_m(self, outline: int, columns: int) -> Float[np.ndarray, "{columns}"]:
        """Wall profile (m) of an outline, by column of the picture."""
        return wall_profile(np.zeros((1, 2)), np.zeros(1), self.outlines[outline].walls_m[None], columns)[0]

    def classes(self, columns: int) -> Int[np.ndarray, "{columns}"]:
        """Code in `conventions.OPENING_CLASSES` of what each column of the picture shows; of the first outline."""
        at = (np.arange(columns) + 0.5) / columns
        classes = np.zeros(columns, dtype=int)
        for kind, left, right in self.class_spans:
            classes[(at - left) % 1.0 < (right - left) % 1.0] = OPENING_CLASSES.index(kind)
        return classes


def is_annotation(path: Path) -> bool:
    """Whether a JSON file is an annotation, by its keys; not whether it is a right one."""
    try:
        document = read_json(path)
    except DatasetError:
        return False
    return "photograph" in document and "polygon" in document


def read_annotation(path: Path) -> AnnotatedPhotograph:
    """Read one annotation; of the photograph itself only the size.

    Raises:
        DatasetError: it is damaged or says what cannot be, or its photograph is missing.
    """
    document = read_json(path, scene=path.stem)
    reader = _Reader(path)
    reader.check_keys(document)
    photograph, width = reader.photograph(document["photograph"])
    quality = document["quality"]
    if quality not in get_args(Quality):
        raise reader.error(f"quality is {quality!r}, it must be one of {', '.join(get_args(Quality))}")
    spans = reader.openings(document["openings"], width)
    room = DrawnRoom(
        name=path.stem,
        polygon_m=reader.polygon(document["polygon"], "polygon"),
        ceiling_height_m=reader.ceiling_height_m(document["ceiling_above_camera"]),
        room_type=room_type_from_label(reader.text(document, "room_type")),
    )
    polygons = {"polygon": room.polygon_m}
    if document.get("alternative_polygon") is not None:
        polygons["alternative_polygon"] = reader.polygon(document["alternative_polygon"], "alternative_polygon")
    outlines = [reader.outline(replace(room, polygon_m=polygon), room, spans, key) for key, polygon in polygons.items()]
    reader.check_lines(document["openings"], outlines[0])
    return AnnotatedPhotograph(
        name=path.stem,
        photograph=photograph,
        quality=cast(Quality, quality),
        outlines=tuple(outlines),
        has_flat_ceiling=document["ceiling_above_camera"] is not None,
        class_spans=spans,
        notes=reader.text(document, "notes"),
    )


class _Reader:
    """Reads the parts of one annotation; errors name its file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def error(self, reason: str) -> DatasetError:
        return DatasetError(reason, scene=self._path.stem, path=self._path)

    def check_keys(self, document: Mapping[str, Any]) -> None:
        unknown = sorted(set(document) - _REQUIRED - _OPTIONAL)
        missing = sorted(_REQUIRED - set(document))
        if unknown:
            raise self.error(f"unknown key '{unknown[0][:50]}', known are {', '.join(sorted(_REQUIRED | _OPTIONAL))}")
        if missing:
            raise self.error(f"the key '{missing[0]}' is missing")

    def ceiling_height_m(self, raw: Any) -> float:
        """Height of the ceiling over the floor; a usual one where none is given."""
        if raw is not None and not (is_number(raw) and 0.0 < raw <= _MAX_REACH):
            raise self.error(f"ceiling_above_camera is {raw!r}, it must be null or above 0 and at most {_MAX_REACH:g}")
        return CAMERA_HEIGHT_M * (1.0 + (_USUAL_CEILING if raw is None else float(raw)))

    def text(self, document: Mapping[str, Any], key: str) -> str:
        text = document.get(key, "")
        if not isinstance(text, str):
            raise self.error(f"{key} must be text, not {type(text).__name__}")
        return text

    def photograph(self, named: Any) -> tuple[FilePhotograph, int]:
        """The photograph, and its width in pixels."""
        path = inside(self._path.parent, named) if isinstance(named, str) else None
        if path is None:
            raise self.error(f"photograph is {named!r}, it must be a path below the annotation's folder")
        try:
            with Image.open(path) as image:
                width = image.width
        except UnidentifiedImageError as error:
            raise self.error(f"photograph '{named}' is not a readable picture") from error
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise self.error(f"photograph '{named}' cannot be read: {error}") from error
        return FilePhotograph(path=path, scene=self._path.stem, room=named), width

    def polygon(self, raw: Any, key: str) -> Float[np.ndarray, "n 2"]:
        """An outline (m), validated as rooms of floor plans are, with the camera inside."""
        polygon_m = self._points(raw, key, 3, _MAX_VERTICES) * CAMERA_HEIGHT_M
        shape = {"name": self._path.stem, "polygon": polygon_m.tolist(), "ceiling_height_m": 2.0 * CAMERA_HEIGHT_M}
        try:
            (room,) = FloorPlan.from_dict({"rooms": [shape]}).rooms
        except InvalidFloorPlanError as error:
            raise self.error(f"{key}: {error.reason} (for a camera {CAMERA_HEIGHT_M:g} m over the floor)") from error
        if not room.shape.contains(shapely.Point(0.0, 0.0)):
            raise self.error(f"{key}: the camera at (0, 0) stands outside of it")
        return room.polygon_m

    def outline(self, room: DrawnRoom, seen: DrawnRoom, spans: Sequence[ClassSpan], key: str) -> DrawnRoom:
        """A room with those openings, seen in the outline of another, that lie in both outlines."""
        drawn = replace(room, openings=tuple(piece for span in spans for piece in _pieces(room, seen, span)))
        try:
            plan_of_rooms(self._path.stem, [drawn], CAMERA_HEIGHT_M)
        except InvalidFloorPlanError as error:
            raise self.error(f"{key}: {error.reason} (for a camera {CAMERA_HEIGHT_M:g} m over the floor)") from error
        return drawn

    def openings(self, raw: Any, width: int) -> tuple[ClassSpan, ...]:
        """Kinds of openings with the columns that they take up, as shares of the width."""
        if not isinstance(raw, list) or len(raw) > _MAX_OPENINGS:
            raise self.error(f"openings must be a list of at most {_MAX_OPENINGS}")
        spans = []
        for number, one in enumerate(raw):
            what = f"opening {number}"
            if not isinstance(one, Mapping) or set(one) != _OPENING_KEYS:
                raise self.error(f"{what} must be an object with the keys {', '.join(sorted(_OPENING_KEYS))}")
            if one["kind"] not in OPENING_CLASSES[1:]:
                raise self.error(f"{what}: kind is {one['kind']!r}, it must be one of {', '.join(OPENING_CLASSES[1:])}")
            left, right = self._columns(one["columns"], what, width)
            line = self._points(one["line"], f"{what}: line", 2, 2)
            self._check_sides(line, (left, right), what, width)
            spans.append((one["kind"], left, right))
        return tuple(spans)

    def check_lines(self, raw: list[Any], outline: DrawnRoom) -> None:
        """Check that openings which were read begin and end on the outline."""
        ring = shapely.LinearRing(outline.polygon_m / CAMERA_HEIGHT_M)
        for number, one in enumerate(raw):
            away = float(shapely.distance(ring, shapely.points(np.array(one["line"]))).max())
            if away > _OFF_THE_WALL:
                raise self.error(
                    f"opening {number}: an end of its line is {away:.2g} off the outline, at most {_OFF_THE_WALL:g} is "
                    "allowed"
                )

    def _columns(self, raw: Any, what: str, width: int) -> tuple[float, float]:
        if (
            not isinstance(raw, list)
            or len(raw) != 2
            or not all(is_number(column) and 0.0 <= column <= width for column in raw)
        ):
            raise self.error(f"{what}: columns are {raw!r}, they must be two numbers from 0 to the width, {width}")
        return raw[0] / width, raw[1] / width

    def _check_sides(self, line: Float[np.ndarray, "2 2"], sides: tuple[float, float], what: str, width: int) -> None:
        seen = np.arctan2(line[:, 0], line[:, 1]) / TWO_PI + 0.5
        away = np.abs(wrap_angle(TWO_PI * (seen - np.array(sides)))) / TWO_PI
        if away.max() > _COLUMN_TOLERANCE:
            shown, said = (", ".join(f"{share * width:.0f}" for share in pair) for pair in (seen, sides))
            raise self.error(
                f"{what}: the ends of its line are seen at the columns {shown}, but its columns are {said}; they may "
                f"differ by {_COLUMN_TOLERANCE * width:.0f}"
            )

    def _points(self, raw: Any, what: str, least: int, most: int) -> Float[np.ndarray, "n 2"]:
        if not isinstance(raw, list) or not least <= len(raw) <= most:
            raise self.error(f"{what} must be a list of {least} to {most} points [x, y]")
        for point in raw:
            if not isinstance(point, list) or len(point) != 2 or not all(map(is_number, point)):
                raise self.error(f"{what}: a point is {str(point)[:50]}, it must be two numbers [x, y]")
            if max(map(abs, point)) > _MAX_REACH:
                raise self.error(
                    f"{what}: a point is {str(point)[:50]}, more than {_MAX_REACH:g} camera heights away; "
                    "are lengths in camera heights?"
                )
        return np.array(raw, dtype=np.float64)


def _pieces(room: DrawnRoom, seen: DrawnRoom, span: ClassSpan) -> list[DrawnOpening]:
    """The pieces of a room's walls that an opening takes up, as far as they are seen.

    Its edges may be those of something before it, so its line is no piece of a wall.
    """
    kind, left, right = span
    share = left + (right - left) % 1.0 * (np.arange(_RAYS) + 0.5) / _RAYS
    azimuth = TWO_PI * (share - 0.5)
    place, wall = _met(room, azimuth)
    same = np.linalg.norm(place - _met(seen, azimuth)[0], axis=1) <= _SAME_PLACE_M
    pieces = []
    for number in np.unique(wall[same]):
        met = place[same & (wall == number)]
        if len(met) >= _MIN_SHARE * _RAYS:
            pieces.append(DrawnOpening(kind=kind, line_m=met[[0, -1]]))
    return pieces


def _met(room: DrawnRoom, azimuth: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, "n"]]:
    """Where rays from the camera meet a room's walls, and which."""
    distance_m, wall = nearest_walls(np.zeros((1, 2)), azimuth[None], room.walls_m[None])
    return distance_m[0, :, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1), wall[0]
