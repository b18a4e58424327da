"""Plans of copies of a home that differ in their doors only: which copy a photograph shows, doors alone tell."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lalaloc_core.data.dataset import Appearance, Camera, Scene, Split
from lalaloc_core.data.synthetic.generated import GeneratedScenes
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan

# Free space between two copies (m): no multiple of a grid's step, so that its lattice lies otherwise in each.
_APART_M = 3.17
# Share of the doors that a copy other than the photographed one has.
_DOORS_KEPT = 0.5


@dataclass(frozen=True)
class CopiedScenes:
    """Generated homes as plans of so many copies in a row, of which one, drawn for each home, is photographed.

    The other copies lack some of its doors, each at least one. Nothing tells the copies of a home without doors apart.
    """

    homes: GeneratedScenes
    copies: int = 4

    @property
    def description(self) -> str:
        return f"{self.homes.description}, {self.copies} copies that differ in their doors"

    @property
    def appearances(self) -> Sequence[Appearance]:
        return self.homes.appearances

    def scenes(self, split: Split) -> Sequence[str]:
        return self.homes.scenes(split)

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        scene = self.homes.load(name, problems)
        rng = np.random.default_rng([self.homes.seed, zlib.crc32(name.encode())])
        own = int(rng.integers(self.copies))
        x_min, _, x_max, _ = scene.plan.bounds_m
        step_m = x_max - x_min + _APART_M
        document = scene.plan.to_dict()
        rooms, openings = [], []
        for copy in range(self.copies):
            by_m = copy * step_m
            rooms += [_moved_room(room, copy, by_m) for room in document["rooms"]]
            kept = document.get("openings", [])
            if copy != own:
                kept = _fewer_doors(kept, rng)
            openings += [_moved_opening(opening, copy, by_m) for opening in kept]
        plan = FloorPlan.from_dict(
            {**document, "rooms": rooms, "openings": openings, "opening_kinds": sorted(scene.plan.opening_kinds)}
        )
        cameras = tuple(_moved_camera(one, own * step_m, own * len(scene.plan.rooms)) for one in scene.cameras)
        return dataclasses.replace(scene, plan=plan, cameras=cameras)


def _fewer_doors(openings: list[dict[str, Any]], rng: np.random.Generator) -> list[dict[str, Any]]:
    doors = [index for index, opening in enumerate(openings) if opening["kind"] == "door"]
    if not doors:
        return openings
    gone = {index for index in doors if rng.random() >= _DOORS_KEPT} | {int(rng.choice(doors))}
    return [opening for index, opening in enumerate(openings) if index not in gone]


def _moved_room(room: dict[str, Any], copy: int, by_m: float) -> dict[str, Any]:
    lists = {key: [_moved(points, by_m) for points in room[key]] for key in ("holes", "walls") if key in room}
    return {**room, **lists, "id": f"{room['id']}-copy-{copy}", "polygon": _moved(room["polygon"], by_m)}


def _moved_opening(opening: dict[str, Any], copy: int, by_m: float) -> dict[str, Any]:
    rooms = {"rooms": [f"{room}-copy-{copy}" for room in opening["rooms"]]} if "rooms" in opening else {}
    return {**opening, **rooms, "line": _moved(opening["line"], by_m)}


def _moved(points: list[list[float]], by_m: float) -> list[list[float]]:
    return [[x + by_m, y] for x, y in points]


def _moved_camera(camera: Camera, by_m: float, rooms: int) -> Camera:
    return dataclasses.replace(
        camera, position_m=camera.position_m + np.array([by_m, 0.0]), room_index=camera.room_index + rooms
    )
