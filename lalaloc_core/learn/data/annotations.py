"""Annotated photographs of real rooms whose place in a building is unknown.

    ROOT/<name>.json   outline of the room around the camera, in camera heights, and its openings
    ROOT/<name>.jpg    the sphere, named in the annotation

docs/reference/datasets.md describes the format. A photograph does not change when room and camera height are scaled
together, so lengths are converted for a camera `CAMERA_HEIGHT_M` above the floor.
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
from lalaloc_core.learn.data.assembly import is_number, path_below, read_json
from lalaloc_core.learn.data.dataset import FilePhotograph
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening, DrawnRoom, plan_of_rooms
from lalaloc_core.render.profile import nearest_walls, wall_profile

CAMERA_HEIGHT_M = 1.5
# Assumed height of a ceiling that is not flat, above the camera in camera heights.
_DEFAULT_CEILING = 1.2
Quality = Literal["good", "fair", "poor"]
# Kind of an opening, and the columns of its left and right edge as shares of the picture's width; left is larger than
# right if the opening crosses the picture's border.
ClassSpan = tuple[str, float, float]

_REQUIRED = {"photograph", "quality", "polygon", "ceiling_above_camera", "openings"}
_OPTIONAL = {"alternative_polygon", "room_type", "notes"}
_OPENING_KEYS = {"kind", "columns", "line"}
_MAX_VERTICES, _MAX_OPENINGS = 200, 100
# In camera heights: maximum coordinate, and maximum distance between the ends of an opening and the outline.
_MAX_REACH, _MAX_OFFSET = 60.0, 0.1
# Maximum difference between an opening's columns and its line, as a share of the picture's width.
_COLUMN_TOLERANCE = 0.01
# Rays cast between the edges of an opening, minimum share of them on each of its walls, and maximum distance (m)
# between the points where a ray meets two outlines that share the opening.
_RAYS, _MIN_SHARE, _SAME_PLACE_M = 64, 0.2, 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class AnnotatedPhotograph:
    """Photograph with its annotation; metres, camera at (0, 0), +y along the picture's centre column."""

    name: str
    photograph: FilePhotograph
    quality: Quality
    outlines: tuple[DrawnRoom, ...]
    class_spans: tuple[ClassSpan, ...]
    notes: str = ""

    @property
    def counts(self) -> bool:
        """True if the quality suffices for metrics."""
        return self.quality != "poor"

    def profile_m(self, outline: int, columns: int) -> Float[np.ndarray, "{columns}"]:
        """Return the wall profile (m) of an outline by column of the picture."""
        return wall_profile(np.zeros((1, 2)), np.zeros(1), self.outlines[outline].walls_m[None], columns)[0]

    def classes(self, columns: int) -> Int[np.ndarray, "{columns}"]:
        """Return the code in `conventions.OPENING_CLASSES` of each column of the picture, for the first outline."""
        share = (np.arange(columns) + 0.5) / columns
        classes = np.zeros(columns, dtype=int)
        for kind, left, right in self.class_spans:
            classes[(share - left) % 1.0 < (right - left) % 1.0] = OPENING_CLASSES.index(kind)
        return classes


def is_annotation(path: Path) -> bool:
    """Return whether a JSON file has the keys of an annotation; its values are not checked."""
    try:
        document = read_json(path)
    except DatasetError:
        return False
    return "photograph" in document and "polygon" in document


def read_annotation(path: Path) -> AnnotatedPhotograph:
    """Read an annotation, and the size of its photograph."""
    document = read_json(path, scene=path.stem)
    reader = _Reader(path)
    reader.check_keys(document)
    photograph, width = reader.photograph(document["photograph"])
    quality = document["quality"]
    if quality not in get_args(Quality):
        raise reader.error(f"quality is {quality!r}; it must be one of {', '.join(get_args(Quality))}")
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
        class_spans=spans,
        notes=reader.text(document, "notes"),
    )


class _Reader:
    """Reader of one annotation; errors name its file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def error(self, reason: str) -> DatasetError:
        return DatasetError(reason, scene=self._path.stem, path=self._path)

    def check_keys(self, document: Mapping[str, Any]) -> None:
        unknown = sorted(set(document) - _REQUIRED - _OPTIONAL)
        missing = sorted(_REQUIRED - set(document))
        if unknown:
            raise self.error(
                f"unknown key '{unknown[0][:50]}'; known keys are {', '.join(sorted(_REQUIRED | _OPTIONAL))}"
            )
        if missing:
            raise self.error(f"the key '{missing[0]}' is missing")

    def ceiling_height_m(self, raw: Any) -> float:
        if raw is not None and not (is_number(raw) and 0.0 < raw <= _MAX_REACH):
            raise self.error(f"ceiling_above_camera is {raw!r}; it must be null, or above 0 and at most {_MAX_REACH:g}")
        return CAMERA_HEIGHT_M * (1.0 + (_DEFAULT_CEILING if raw is None else float(raw)))

    def text(self, document: Mapping[str, Any], key: str) -> str:
        text = document.get(key, "")
        if not isinstance(text, str):
            raise self.error(f"{key} must be text, not {type(text).__name__}")
        return text

    def photograph(self, value: Any) -> tuple[FilePhotograph, int]:
        path = path_below(self._path.parent, value) if isinstance(value, str) else None
        if path is None:
            raise self.error(f"photograph is {value!r}; it must be a path below the annotation's folder")
        try:
            with Image.open(path) as image:
                width = image.width
        except UnidentifiedImageError as error:
            raise self.error(f"photograph '{value}' is not a readable picture") from error
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise self.error(f"photograph '{value}' cannot be read: {error}") from error
        return FilePhotograph(path=path, scene=self._path.stem, room=value), width

    def polygon(self, raw: Any, key: str) -> Float[np.ndarray, "n 2"]:
        """Return an outline (m), validated like a room of a floor plan, with the camera inside."""
        polygon_m = self._points(raw, key, 3, _MAX_VERTICES) * CAMERA_HEIGHT_M
        shape = {"name": self._path.stem, "polygon": polygon_m.tolist(), "ceiling_height_m": 2.0 * CAMERA_HEIGHT_M}
        try:
            (room,) = FloorPlan.from_dict({"rooms": [shape]}).rooms
        except InvalidFloorPlanError as error:
            raise self.error(f"{key}: {error.reason} (for a camera {CAMERA_HEIGHT_M:g} m above the floor)") from error
        if not room.shape.contains(shapely.Point(0.0, 0.0)):
            raise self.error(f"{key}: the camera at (0, 0) is outside the outline")
        return room.polygon_m

    def outline(self, room: DrawnRoom, annotated: DrawnRoom, spans: Sequence[ClassSpan], key: str) -> DrawnRoom:
        """Add to a room the openings, annotated for another outline, that lie on both outlines."""
        drawn = replace(room, openings=tuple(piece for span in spans for piece in _pieces(room, annotated, span)))
        try:
            plan_of_rooms(self._path.stem, [drawn], CAMERA_HEIGHT_M)
        except InvalidFloorPlanError as error:
            raise self.error(f"{key}: {error.reason} (for a camera {CAMERA_HEIGHT_M:g} m above the floor)") from error
        return drawn

    def openings(self, raw: Any, width: int) -> tuple[ClassSpan, ...]:
        if not isinstance(raw, list) or len(raw) > _MAX_OPENINGS:
            raise self.error(f"openings must be a list of at most {_MAX_OPENINGS} entries")
        spans = []
        for number, entry in enumerate(raw):
            label = f"opening {number}"
            if not isinstance(entry, Mapping) or set(entry) != _OPENING_KEYS:
                raise self.error(f"{label} must be an object with the keys {', '.join(sorted(_OPENING_KEYS))}")
            kind = entry["kind"]
            if kind not in OPENING_CLASSES[1:]:
                raise self.error(f"{label}: kind is {kind!r}; it must be one of {', '.join(OPENING_CLASSES[1:])}")
            left, right = self._columns(entry["columns"], label, width)
            line = self._points(entry["line"], f"{label}: line", 2, 2)
            self._check_sides(line, (left, right), label, width)
            spans.append((kind, left, right))
        return tuple(spans)

    def check_lines(self, raw: list[Any], outline: DrawnRoom) -> None:
        """Check that the openings begin and end on the outline."""
        ring = shapely.LinearRing(outline.polygon_m / CAMERA_HEIGHT_M)
        for number, entry in enumerate(raw):
            away = float(shapely.distance(ring, shapely.points(np.array(entry["line"]))).max())
            if away > _MAX_OFFSET:
                raise self.error(
                    f"opening {number}: an end of its line is {away:.2g} camera heights from the outline; the limit is "
                    f"{_MAX_OFFSET:g}"
                )

    def _columns(self, raw: Any, label: str, width: int) -> tuple[float, float]:
        if (
            not isinstance(raw, list)
            or len(raw) != 2
            or not all(is_number(column) and 0.0 <= column <= width for column in raw)
        ):
            raise self.error(f"{label}: columns are {raw!r}; they must be two numbers from 0 to the width, {width}")
        return raw[0] / width, raw[1] / width

    def _check_sides(self, line: Float[np.ndarray, "2 2"], sides: tuple[float, float], label: str, width: int) -> None:
        ends = np.arctan2(line[:, 0], line[:, 1]) / TWO_PI + 0.5
        away = np.abs(wrap_angle(TWO_PI * (ends - np.array(sides)))) / TWO_PI
        if away.max() > _COLUMN_TOLERANCE:
            line_columns, columns = (", ".join(f"{share * width:.0f}" for share in pair) for pair in (ends, sides))
            raise self.error(
                f"{label}: the ends of its line are at the columns {line_columns}, but its columns are {columns}; the "
                f"maximum difference is {_COLUMN_TOLERANCE * width:.0f}"
            )

    def _points(self, raw: Any, label: str, low: int, high: int) -> Float[np.ndarray, "n 2"]:
        if not isinstance(raw, list) or not low <= len(raw) <= high:
            raise self.error(f"{label} must be a list of {low} to {high} points [x, y]")
        for point in raw:
            if not isinstance(point, list) or len(point) != 2 or not all(map(is_number, point)):
                raise self.error(f"{label}: a point is {str(point)[:50]}; it must be two numbers [x, y]")
            if max(map(abs, point)) > _MAX_REACH:
                raise self.error(
                    f"{label}: a point is {str(point)[:50]}; the limit is {_MAX_REACH:g}, and lengths are in camera "
                    "heights"
                )
        return np.array(raw, dtype=np.float64)


def _pieces(room: DrawnRoom, annotated: DrawnRoom, span: ClassSpan) -> list[DrawnOpening]:
    """Return the visible pieces of a room's walls that an opening, perhaps partly occluded, covers."""
    kind, left, right = span
    share = left + (right - left) % 1.0 * (np.arange(_RAYS) + 0.5) / _RAYS
    azimuth = TWO_PI * (share - 0.5)
    place, wall = _cast(room, azimuth)
    same = np.linalg.norm(place - _cast(annotated, azimuth)[0], axis=1) <= _SAME_PLACE_M
    pieces = []
    for number in np.unique(wall[same]):
        hits = place[same & (wall == number)]
        if len(hits) >= _MIN_SHARE * _RAYS:
            pieces.append(DrawnOpening(kind=kind, line_m=hits[[0, -1]]))
    return pieces


def _cast(room: DrawnRoom, azimuth: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, "n"]]:
    """Return the points and the walls where rays from the camera meet a room."""
    distance_m, wall = nearest_walls(np.zeros((1, 2)), azimuth[None], room.walls_m[None])
    return distance_m[0, :, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1), wall[0]
