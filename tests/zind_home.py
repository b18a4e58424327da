"""Small homes in ZInD's structure with known poses.

A right-handed plan with true poses is mirrored into ZInD's frame, and every sphere gets a frame of its own with a
random turn, scale and place. Its picture is painted from that frame alone, by ZInD's rule that a point (x, y) is seen
at the image azimuth atan2(-x, y): each wall in a colour of its own, floor and ceiling in grey.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from PIL import Image

from lalaloc_core.floorplan import FloorPlan
from tests.strategies import crooked_flat

FLOOR = "floor_01"
HEIGHT, WIDTH = 128, 256
PARTITION = {"train": ["0000"], "val": ["0001"], "test": ["0002"]}
FLOOR_GREY, CEILING_GREY = 60, 200


@dataclass(frozen=True, kw_only=True)
class TrueSphere:
    """True pose of a sphere in the plan frame: metres, radians clockwise from +y."""

    room_index: int
    x_m: float
    y_m: float
    heading: float
    height_m: float = 1.5
    primary: bool = True

    def name(self, number: int) -> str:
        """Return the camera's name of sphere `number` of its floor."""
        return f"partial_room_{self.room_index + 1:02d}_pano_{number}"


SPHERES = (
    TrueSphere(room_index=0, x_m=1.2, y_m=1.4, heading=0.7),
    TrueSphere(room_index=0, x_m=3.1, y_m=1.0, heading=4.0, primary=False),
    TrueSphere(room_index=1, x_m=5.2, y_m=1.2, heading=2.9),
    TrueSphere(room_index=2, x_m=2.0, y_m=4.8, heading=5.9),
    TrueSphere(room_index=2, x_m=4.4, y_m=5.0, heading=1.6, primary=False),
)


def wall_colour(wall: int) -> tuple[int, int, int]:
    """Return the colour of a room's wall by its number."""
    return 255 - 40 * (wall % 5), 30 + 45 * wall % 200, 20 + 90 * (wall % 3)


def write_home(
    folder: Path,
    plan: FloorPlan,
    spheres: Sequence[TrueSphere],
    rng: np.random.Generator,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> None:
    (folder / "panos").mkdir(parents=True)
    scale_m = float(rng.uniform(0.5, 3.0))
    floor: dict[str, Any] = {}
    for number, sphere in enumerate(spheres):
        room = f"room_{sphere.room_index + 1:02d}"
        image_path = f"panos/{FLOOR}_{sphere.name(number)}.jpg"
        data, vertices = _sphere_data(plan, sphere, scale_m, rng)
        data["image_path"] = image_path
        floor.setdefault(f"complete_{room}", {}).setdefault(f"partial_{room}", {})[f"pano_{number}"] = data
        Image.fromarray(_painted(vertices, data["ceiling_height"], size)).save(folder / image_path, quality=95)
    document = {"scale_meters_per_coordinate": {FLOOR: scale_m}, "merger": {FLOOR: floor}, "redraw": {}}
    (folder / "zind_data.json").write_text(json.dumps(document), encoding="utf-8")


def write_homes(root: Path, rng: np.random.Generator, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    """Write one home for each split, and the partition."""
    root.mkdir(parents=True, exist_ok=True)
    for homes in PARTITION.values():
        for home in homes:
            write_home(root / home, crooked_flat(), SPHERES, rng, size)
    (root / "zind_partition.json").write_text(json.dumps(PARTITION), encoding="utf-8")


def _sphere_data(
    plan: FloorPlan, sphere: TrueSphere, scale_m: float, rng: np.random.Generator
) -> tuple[dict[str, Any], np.ndarray]:
    """Return the file's entry of a sphere, and its room's vertices in the sphere's frame."""
    room = plan.rooms[sphere.room_index]
    mirror = np.array([-1.0, 1.0])
    # The sphere's frame has the camera height as its unit, and the centre column along +y.
    scale = sphere.height_m / scale_m
    translation = np.array([sphere.x_m, sphere.y_m]) * mirror / scale_m
    turns = 360.0 * int(rng.integers(-1, 2))
    # In the mirrored frame, clockwise becomes counter-clockwise.
    angle = sphere.heading
    cosine, sine = math.cos(angle), math.sin(angle)

    def own(points: np.ndarray) -> np.ndarray:
        x, y = (points * mirror / scale_m - translation).T
        return np.stack([cosine * x + sine * y, -sine * x + cosine * y], 1) / scale

    vertices = own(room.polygon_m)
    # Rings are closed, as in the data set.
    internal = [own(hole[[*range(len(hole)), 0]]).tolist() for hole in room.holes_m]
    layout = {"vertices": vertices.tolist(), "doors": [], "windows": [], "openings": [], "internal": internal}
    data = {
        "label": f"label {sphere.room_index + 1}",
        "is_primary": sphere.primary,
        "is_inside": True,
        "is_ceiling_flat": True,
        "camera_height": 1.0,
        "ceiling_height": room.ceiling_height_m / sphere.height_m,
        "floor_number": 1,
        "floor_plan_transformation": {
            "translation": translation.tolist(),
            "rotation": math.degrees(angle) + turns,
            "scale": scale,
        },
        "layout_raw": layout,
        "layout_complete": layout,
    }
    return data, vertices


def _painted(vertices: np.ndarray, ceiling_height: float, size: tuple[int, int]) -> np.ndarray:
    """Paint the sphere of a room in the sphere's frame, the camera at its origin, one unit above the floor."""
    height, width = size
    pixels = np.zeros((height, width, 3), dtype=np.uint8)
    walls = [shapely.LineString([vertex, vertices[(k + 1) % len(vertices)]]) for k, vertex in enumerate(vertices)]
    elevation = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    for column in range(width):
        image_azimuth = 2.0 * math.pi * ((column + 0.5) / width - 0.5)
        # Direction whose atan2(-x, y) is this azimuth.
        x, y = -math.sin(image_azimuth), math.cos(image_azimuth)
        ray = shapely.LineString([(0.0, 0.0), (999.0 * x, 999.0 * y)])
        crossings = [wall.intersection(ray) for wall in walls]
        distances = [shapely.Point(0.0, 0.0).distance(c) if not c.is_empty else math.inf for c in crossings]
        wall = int(np.argmin(distances))
        rises = distances[wall] * np.tan(elevation)
        pixels[:, column] = wall_colour(wall)
        pixels[rises < -1.0, column] = FLOOR_GREY
        pixels[rises > ceiling_height - 1.0, column] = CEILING_GREY
    return pixels
