"""Tiny scenes in Structured3D's layout, written independently of the reader under test."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from PIL import Image

from lalaloc_core.floorplan import FloorPlan, Room

HEIGHT, WIDTH = 32, 64
ROOM_TYPES = ("living room", "kitchen", "bedroom", "undefined")


@dataclass
class Drawing:
    """Planes, lines and junctions of an annotation; millimetres."""

    junctions: list[list[float]] = field(default_factory=list)
    lines: list[tuple[int, ...]] = field(default_factory=list)
    planes: list[tuple[str, list[int]]] = field(default_factory=list)
    semantics: list[dict[str, Any]] = field(default_factory=list)

    def junction(self, x: float, y: float, z: float) -> int:
        self.junctions.append([x, y, z])
        return len(self.junctions) - 1

    def line(self, start: int, end: int) -> int:
        self.lines.append((start, end))
        return len(self.lines) - 1

    def ring(self, corners: Sequence[int]) -> list[int]:
        return [self.line(corner, corners[(k + 1) % len(corners)]) for k, corner in enumerate(corners)]

    def plane(self, kind: str, lines: Sequence[int]) -> int:
        self.planes.append((kind, list(lines)))
        return len(self.planes) - 1

    def prism(self, polygon_mm: np.ndarray, floor_mm: float, ceiling_mm: float) -> list[int]:
        """Add the floor, ceiling and walls of a room; return their planes."""
        below = [self.junction(x, y, floor_mm) for x, y in polygon_mm.tolist()]
        above = [self.junction(x, y, ceiling_mm) for x, y in polygon_mm.tolist()]
        floor, ceiling = self.ring(below), self.ring(above)
        uprights = [self.line(*ends) for ends in zip(below, above, strict=True)]
        planes = [self.plane("floor", floor), self.plane("ceiling", ceiling)]
        for k in range(len(below)):
            planes.append(self.plane("wall", [floor[k], uprights[(k + 1) % len(below)], ceiling[k], uprights[k]]))
        return planes

    def opening(self, wall: int, start_mm: np.ndarray, end_mm: np.ndarray, sill_mm: float, head_mm: float) -> int:
        """Add a door or window, a hole in a wall with its own plane; return that plane."""
        corners = [
            self.junction(float(point_mm[0]), float(point_mm[1]), z)
            for point_mm, z in ((start_mm, sill_mm), (end_mm, sill_mm), (end_mm, head_mm), (start_mm, head_mm))
        ]
        ring = self.ring(corners)
        self.planes[wall][1].extend(ring)
        return self.plane("wall", ring)

    def to_document(self, rng: np.random.Generator) -> dict[str, Any]:
        """Return the annotation with shuffled lines and junctions."""
        line_order = rng.permutation(len(self.lines)).tolist()
        junction_order = rng.permutation(len(self.junctions)).tolist()
        line_place = {line: place for place, line in enumerate(line_order)}
        junction_place = {junction: place for place, junction in enumerate(junction_order)}
        plane_lines = np.zeros((len(self.planes), len(self.lines)), dtype=int)
        for plane, (_, lines) in enumerate(self.planes):
            plane_lines[plane, [line_place[line] for line in lines]] = 1
        line_junctions = np.zeros((len(self.lines), len(self.junctions)), dtype=int)
        for line, ends in enumerate(self.lines):
            line_junctions[line_place[line], [junction_place[end] for end in ends]] = 1
        return {
            "junctions": [
                {"ID": place, "coordinate": self.junctions[junction]} for place, junction in enumerate(junction_order)
            ],
            "lines": [
                {"ID": place, "point": self.junctions[self.lines[line][0]], "direction": [0.0, 0.0, 1.0]}
                for place, line in enumerate(line_order)
            ],
            "planes": [
                {"ID": plane, "type": kind, "normal": [0.0, 0.0, 1.0], "offset": 0.0}
                for plane, (kind, _) in enumerate(self.planes)
            ],
            "semantics": self.semantics,
            "planeLineMatrix": plane_lines.tolist(),
            "lineJunctionMatrix": line_junctions.tolist(),
            "cuboids": [],
            "manhattan": [],
        }


def room_id(index: int) -> str:
    """Return the ID of a room of the plan in the annotation."""
    return str(1007 + 13 * index)


def drawing_of(plan: FloorPlan, rng: np.random.Generator, floor_m: float = 0.0) -> Drawing:
    """Draw a plan as an annotation: rooms start at any corner in any sense, each with a door and a window."""
    drawing = Drawing()
    for index, room in enumerate(plan.rooms):
        polygon_mm = 1000.0 * np.roll(room.polygon_m, int(rng.integers(len(room.polygon_m))), axis=0)
        polygon_mm = polygon_mm[:: int(rng.choice([-1, 1]))]
        floor_mm = 1000.0 * floor_m
        planes = drawing.prism(polygon_mm, floor_mm, floor_mm + 1000.0 * room.ceiling_height_m)
        drawing.semantics.append(
            {"ID": int(room_id(index)), "type": ROOM_TYPES[index % len(ROOM_TYPES)], "planeID": planes}
        )
        corners = polygon_mm[0], polygon_mm[1]
        for kind, (start, end), sill_mm in (("door", (0.2, 0.5), 0.0), ("window", (0.6, 0.9), 900.0)):
            points = [corners[0] + share * (corners[1] - corners[0]) for share in (start, end)]
            hole = drawing.opening(planes[2], points[0], points[1], floor_mm + sill_mm, floor_mm + 1900.0)
            drawing.semantics.append({"ID": 1008 + 13 * index + len(kind), "type": kind, "planeID": [hole]})
    x0, y0, x1, y1 = (1000.0 * value for value in plan.bounds_m)
    outside = np.array([[x0 - 200, y0 - 200], [x1 + 200, y0 - 200], [x1 + 200, y1 + 200], [x0 - 200, y1 + 200]])
    drawing.semantics.append({"ID": 1, "type": "outwall", "planeID": drawing.prism(outside, 0.0, 3000.0)[2:]})
    return drawing


@dataclass(frozen=True, kw_only=True)
class Stand:
    """Camera position and height above the floor in metres."""

    room_index: int
    x_m: float
    y_m: float
    height_m: float = 1.4


def write_scene(
    folder: Path,
    plan: FloorPlan,
    stands: Sequence[Stand],
    rng: np.random.Generator,
    *,
    floor_m: float = 0.0,
    appearances: Sequence[tuple[str, str]] = (("full", "warm"),),
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> None:
    """Write a scene's annotation and the spheres of its cameras."""
    folder.mkdir(parents=True)
    write_annotation(folder, drawing_of(plan, rng, floor_m).to_document(rng))
    for stand in stands:
        sphere = folder / "2D_rendering" / room_id(stand.room_index) / "panorama"
        sphere.mkdir(parents=True)
        write_camera(sphere, 1000.0 * stand.x_m, 1000.0 * stand.y_m, 1000.0 * (floor_m + stand.height_m))
        for furniture, lighting in appearances:
            (sphere / furniture).mkdir(exist_ok=True)
            pixels = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(sphere / furniture / f"rgb_{lighting}light.png")
            Image.fromarray(depth_mm(plan.rooms[stand.room_index], stand, size)).save(sphere / furniture / "depth.png")


def write_annotation(folder: Path, document: dict[str, Any]) -> None:
    (folder / "annotation_3d.json").write_text(json.dumps(document), encoding="utf-8")


def write_camera(sphere: Path, x_mm: float, y_mm: float, z_mm: float) -> None:
    (sphere / "camera_xyz.txt").write_text(f"{x_mm} {y_mm} {z_mm}\n", encoding="ascii")


def write_synthetic(root: Path, **changes: Any) -> None:
    """Mark a folder as generated scenes with small spheres."""
    document = {"format": 1, "seed": 5, "height": HEIGHT, "width": WIDTH, "textures": None, **changes}
    (root / "synthetic.json").write_text(json.dumps(document), encoding="utf-8")


def depth_mm(room: Room, stand: Stand, size: tuple[int, int]) -> np.ndarray:
    """Cast the depth of the bare room ray by ray in the frame of the data set's tools: x = r sin, y = r cos."""
    height, width = size
    depth = np.zeros(size, dtype=np.uint16)
    outline = shapely.Polygon(room.polygon_m).exterior
    for column in range(width):
        azimuth = 2.0 * math.pi * ((column + 0.5) / width - 0.5)
        far = (stand.x_m + 99.0 * math.sin(azimuth), stand.y_m + 99.0 * math.cos(azimuth))
        ray = shapely.LineString([(stand.x_m, stand.y_m), far])
        wall_m = shapely.Point(stand.x_m, stand.y_m).distance(ray.intersection(outline))
        for row in range(height):
            elevation = math.pi * (0.5 - (row + 0.5) / height)
            reach_m = wall_m / math.cos(elevation)
            limit_m = room.ceiling_height_m - stand.height_m if elevation > 0.0 else stand.height_m
            depth[row, column] = round(1000.0 * min(reach_m, limit_m / abs(math.sin(elevation))))
    return depth
