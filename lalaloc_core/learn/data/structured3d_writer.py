"""Writer of scenes in Structured3D's layout, the counterpart of `structured3d`: millimetres, z up.

Every room is a prism of planes, every door or window a box between two walls, and the outer walls form a ring around
the home. A plane's unit normal points into the empty space, and `normal . point + offset = 0` on the plane.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, UInt8
from PIL import Image

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan, Room
from lalaloc_core.learn.data.structured3d import ANNOTATION_FILE, SPHERE_SIZE
from lalaloc_core.learn.synth.furniture.furnish import opening_ends_m
from lalaloc_core.learn.synth.homes.openings import Opening

_MM_PER_M = 1000.0
_MAX_DEPTH_MM = 65535.0
# Higher levels take three times as long and save 10 % of space.
_PNG_COMPRESSION = 1
# Thickness of walls without a room behind them, and depth of doors that lead nowhere.
_OUTER_WALL_M = 0.2
_NICHE_M = 0.05
# Structured3D's names of room types that have other names in this project.
_ROOM_TYPES = {"closet": "store room", "storage": "store room"}
_SAME_ROOM_TYPES = (
    *("living room", "kitchen", "bedroom", "bathroom", "balcony", "corridor", "dining room", "study", "studio"),
    *("store room", "garden", "laundry room", "office", "basement", "garage"),
)


def room_type(name: str) -> str:
    """Return Structured3D's type of a room from its name, such as "bedroom 2"."""
    kind = name.rstrip("0123456789 ")
    kind = _ROOM_TYPES.get(kind, kind)
    return kind if kind in _SAME_ROOM_TYPES else "undefined"


def write_annotation(scene: Path, plan: FloorPlan, openings: Sequence[Opening]) -> None:
    """Write `annotation_3d.json` into the folder of a scene."""
    text = json.dumps(build_annotation(plan, openings), separators=(",", ":"), allow_nan=False)
    (scene / ANNOTATION_FILE).write_text(text, encoding="utf-8")


def build_annotation(plan: FloorPlan, openings: Sequence[Opening]) -> dict[str, Any]:
    """Build the annotation of a home; the semantic with ID k is room k of the plan, whose panoramas are in folder k."""
    drawing = _Drawing()
    rooms = []
    for room in plan.rooms:
        caps, walls = drawing.prism(room.polygon_m, 0.0, room.ceiling_height_m)
        drawing.semantic(room_type(room.name), caps + walls)
        rooms.append(walls)
    for opening in openings:
        twin = _twin(plan, openings, opening)
        if twin is not None and twin.room < opening.room:
            continue
        near, far = opening_ends_m(plan.rooms[opening.room], opening), _far_side_m(plan, opening, twin)
        caps, sides = drawing.prism(np.stack([near[0], far[0], far[1], near[1]]), opening.sill_m, opening.head_m)
        # The box makes a hole in its wall, and one in the wall of the room behind it.
        drawing.add_hole(rooms[opening.room][opening.wall], sides[3])
        if twin is not None:
            drawing.add_hole(rooms[twin.room][twin.wall], sides[1])
        kind = "window" if opening.kind == "window" else "door"
        drawing.semantic(kind, caps + sides)
    outside = [room.shape.buffer(_OUTER_WALL_M, join_style="mitre") for room in plan.rooms]
    outer = []
    # A grid of millimetres avoids edges too short to have a direction.
    for part in shapely.get_parts(shapely.union_all(outside, grid_size=1.0 / _MM_PER_M)):
        ring_m = np.array(part.exterior.coords)[:-1]
        # Clockwise, because the empty space is outside.
        ring_m = ring_m[::-1] if part.exterior.is_ccw else ring_m
        outer += drawing.prism(ring_m, 0.0, float(plan.ceiling_heights_m.max()), is_open=True)[1]
    drawing.semantic("outwall", outer)
    return drawing.document()


def write_camera(sphere: Path, room: Room, position_m: Float[np.ndarray, "2"], camera_height_m: float) -> None:
    """Write the camera position of a room's spheres, and the pixels of the room's corners."""
    x_mm, y_mm, z_mm = (_MM_PER_M * float(value) for value in (*position_m, camera_height_m))
    (sphere / "camera_xyz.txt").write_text(f"{x_mm!r} {y_mm!r} {z_mm!r}\n", encoding="ascii")
    lines = [f"{x:.3f} {y:.3f}\n" for x, y in layout_pixels(room, position_m, camera_height_m).tolist()]
    (sphere / "layout.txt").write_text("".join(lines), encoding="ascii")


def layout_pixels(room: Room, position_m: Float[np.ndarray, "2"], camera_height_m: float) -> Float[np.ndarray, "n 2"]:
    """Return the pixels (x, y) of the room's visible corners, ceiling and floor alternating, from left to right."""
    height, width = SPHERE_SIZE
    # Corners lie on the outline, so a ray to a corner may leave the room by rounding.
    shape = room.shape.buffer(1e-6)
    rays = shapely.linestrings(np.stack([np.broadcast_to(position_m, room.polygon_m.shape), room.polygon_m], axis=1))
    offset = room.polygon_m[shapely.covers(shape, rays)] - position_m
    azimuth, distance = np.arctan2(offset[:, 0], offset[:, 1]), np.hypot(offset[:, 0], offset[:, 1])
    x = (azimuth / TWO_PI + 0.5) * width - 0.5
    rises_m = np.array([room.ceiling_height_m - camera_height_m, -camera_height_m])
    y = (0.5 - np.arctan2(rises_m, distance[:, None]) / np.pi) * height - 0.5
    pixels = np.stack([np.broadcast_to(x[:, None], y.shape), y], axis=-1)
    return pixels[np.argsort(x)].reshape(-1, 2)


def write_picture(path: Path, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a sphere as PNG."""
    Image.fromarray(pixels).save(path, compress_level=_PNG_COMPRESSION)


def write_depth(path: Path, depth_m: Float[np.ndarray, "h w"]) -> None:
    """Write ranges as 16-bit PNG; ranges above 65.535 m become 0, "no reading"."""
    depth_mm = np.rint(depth_m * _MM_PER_M)
    seen = np.isfinite(depth_mm) & (depth_mm <= _MAX_DEPTH_MM)
    Image.fromarray(np.where(seen, depth_mm, 0.0).astype(np.uint16)).save(path, compress_level=_PNG_COMPRESSION)


@dataclass
class _Drawing:
    """Junctions, lines, planes and semantics; lines and planes reference their parts by index."""

    junctions_mm: list[tuple[float, float, float]] = field(default_factory=list)
    lines: list[tuple[int, int]] = field(default_factory=list)
    planes: list[tuple[str, tuple[float, float, float], list[int]]] = field(default_factory=list)
    semantics: list[dict[str, Any]] = field(default_factory=list)

    def prism(
        self, polygon_m: Float[np.ndarray, "n 2"], floor_m: float, ceiling_m: float, *, is_open: bool = False
    ) -> tuple[list[int], list[int]]:
        """Add a vertical prism, empty to the left of its edges; an open one has no floor and ceiling.

        Returns the indices of its floor and ceiling, and of its walls, of which wall k belongs to edge k.
        """
        below, above = ([self._junction(x, y, z) for x, y in polygon_m.tolist()] for z in (floor_m, ceiling_m))
        floor, ceiling = self._ring(below), self._ring(above)
        uprights = [self._line(*ends) for ends in zip(below, above, strict=True)]
        caps, walls = list[int](), list[int]()
        if not is_open:
            caps = [self._plane("floor", (0.0, 0.0, 1.0), floor), self._plane("ceiling", (0.0, 0.0, -1.0), ceiling)]
        for k, (dx, dy) in enumerate((np.roll(polygon_m, -1, axis=0) - polygon_m).tolist()):
            length = float(np.hypot(dx, dy))
            boundary = [floor[k], uprights[(k + 1) % len(uprights)], ceiling[k], uprights[k]]
            walls.append(self._plane("wall", (-dy / length, dx / length, 0.0), boundary))
        return caps, walls

    def add_hole(self, wall: int, face: int) -> None:
        self.planes[wall][2].extend(self.planes[face][2][:4])

    def semantic(self, kind: str, planes: list[int]) -> None:
        self.semantics.append({"ID": len(self.semantics), "type": kind, "planeID": planes})

    def document(self) -> dict[str, Any]:
        points = np.array(self.junctions_mm)
        ends = np.array(self.lines)
        along = points[ends[:, 1]] - points[ends[:, 0]]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        line_junctions = np.zeros((len(ends), len(points)), dtype=int)
        line_junctions[np.arange(len(ends))[:, None], ends] = 1
        plane_lines = np.zeros((len(self.planes), len(ends)), dtype=int)
        planes = []
        for number, (kind, normal, lines) in enumerate(self.planes):
            plane_lines[number, lines] = 1
            offset = -float(np.dot(normal, points[ends[lines[0], 0]]))
            planes.append({"ID": number, "type": kind, "normal": list(normal), "offset": offset})
        return {
            "junctions": [{"ID": number, "coordinate": point} for number, point in enumerate(points.tolist())],
            "lines": [
                {"ID": number, "point": point, "direction": direction}
                for number, (point, direction) in enumerate(
                    zip(points[ends[:, 0]].tolist(), along.tolist(), strict=True)
                )
            ],
            "planes": planes,
            "semantics": self.semantics,
            "planeLineMatrix": plane_lines.tolist(),
            "lineJunctionMatrix": line_junctions.tolist(),
            "cuboids": [],
            "manhattan": [],
        }

    def _junction(self, x_m: float, y_m: float, z_m: float) -> int:
        self.junctions_mm.append((_MM_PER_M * x_m, _MM_PER_M * y_m, _MM_PER_M * z_m))
        return len(self.junctions_mm) - 1

    def _line(self, start: int, end: int) -> int:
        self.lines.append((start, end))
        return len(self.lines) - 1

    def _ring(self, corners: list[int]) -> list[int]:
        return [self._line(corner, corners[(k + 1) % len(corners)]) for k, corner in enumerate(corners)]

    def _plane(self, kind: str, normal: tuple[float, float, float], lines: list[int]) -> int:
        self.planes.append((kind, normal, lines))
        return len(self.planes) - 1


def _twin(plan: FloorPlan, openings: Sequence[Opening], opening: Opening) -> Opening | None:
    """Return the same door in the room behind it; None if there is no room behind it."""
    facing = [twin for twin in openings if (twin.room, twin.neighbour) == (opening.neighbour, opening.room)]

    def middle(opening: Opening) -> np.ndarray:
        return opening_ends_m(plan.rooms[opening.room], opening).mean(axis=0)

    return min(facing, key=lambda twin: float(np.hypot(*(middle(twin) - middle(opening)))), default=None)


def _far_side_m(plan: FloorPlan, opening: Opening, twin: Opening | None) -> Float[np.ndarray, "2 2"]:
    """Return the far ends of an opening's box, in the order of the near ends."""
    if twin is not None:
        return opening_ends_m(plan.rooms[twin.room], twin)[::-1]
    near = opening_ends_m(plan.rooms[opening.room], opening)
    along = (near[1] - near[0]) / np.hypot(*(near[1] - near[0]))
    outward = np.array([along[1], -along[0]])
    far = near + outward * _OUTER_WALL_M
    box = shapely.Polygon([near[0], far[0], far[1], near[1]]).buffer(-1e-6)
    is_free = not any(room.shape.intersects(box) for room in plan.rooms)
    return far if is_free else near + outward * _NICHE_M
