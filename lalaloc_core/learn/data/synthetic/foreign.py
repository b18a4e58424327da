"""Plans of other buildings, with and without openings, and plans without openings of the photographed home.

Calibration uses photographs in such plans (`lalaloc_core.evaluate.calibrate`): a plain room fits somewhere in most
buildings.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.data.synthetic.generated import DerivedScenes

# Of every three homes one is asked for in the next home's plan, one in the same without openings, one in an office.
_KINDS = 3
_GAP_M, _DOOR_M = 0.1, 0.9
_OFFICE_SEED = 5


def without_openings(plan: FloorPlan) -> FloorPlan:
    """Return a plan that shows walls alone."""
    return FloorPlan.from_dict({**plan.to_dict(), "openings": [], "opening_kinds": []})


def office_plan(rng: np.random.Generator) -> FloorPlan:
    """Draw an office: one to three wings, each a corridor between two rows of boxes, most of the same width."""
    rooms: list[dict[str, Any]] = []
    openings: list[dict[str, Any]] = []
    begin_m = 0.0
    for _ in range(int(rng.integers(1, 4))):
        boxes, usual_m, depth_m = int(rng.integers(5, 11)), rng.uniform(2.4, 4.5), rng.uniform(3.0, 6.0)
        corridor_m, ceiling_m = rng.uniform(1.5, 2.4), float(rng.uniform(2.4, 3.2))
        top_m, length_m = begin_m + depth_m + corridor_m + 2 * _GAP_M, 0.0
        for y_m, door_m, window_m in ((begin_m, begin_m + depth_m, begin_m), (top_m, top_m, top_m + depth_m)):
            x_m = 0.0
            for _ in range(boxes):
                width_m = usual_m * rng.choice([1.0, 1.0, 1.0, 2.0]) if rng.random() < 0.8 else rng.uniform(2.4, 7.0)
                rooms.append(_room(f"office {len(rooms)}", "office", x_m, y_m, float(width_m), depth_m, ceiling_m))
                hinge_m = x_m + (0.2 if rng.random() < 0.5 else float(width_m) - 0.2 - _DOOR_M)
                spans = (
                    ("door", hinge_m, hinge_m + _DOOR_M, door_m),
                    ("window", x_m + 0.3, x_m + width_m - 0.3, window_m),
                )
                for kind, start_m, end_m, wall_m in spans:
                    line = [[float(start_m), float(wall_m)], [float(end_m), float(wall_m)]]
                    openings.append({"kind": kind, "line": line, "rooms": [rooms[-1]["id"]]})
                x_m += float(width_m) + _GAP_M
            length_m = max(length_m, x_m)
        y_m = begin_m + depth_m + _GAP_M
        rooms.append(_room(f"corridor {len(rooms)}", "corridor", 0.0, y_m, length_m, corridor_m, ceiling_m))
        begin_m = top_m + depth_m + 2 * _GAP_M
    kinds = ["door", "passage", "window"]
    return FloorPlan.from_dict({"name": "office", "rooms": rooms, "openings": openings, "opening_kinds": kinds})


def _room(
    name: str, kind: str, x_m: float, y_m: float, width_m: float, depth_m: float, ceiling_m: float
) -> dict[str, Any]:
    right, top = x_m + width_m, y_m + depth_m
    polygon = [[x_m, y_m], [right, y_m], [right, top], [x_m, top]]
    return {"id": name, "name": name, "type": kind, "ceiling_height_m": ceiling_m, "polygon": polygon}


@dataclass(frozen=True)
class UnopenedScenes(DerivedScenes):
    """Generated homes whose plans show walls alone."""

    variant: ClassVar[str] = "plans without openings"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene and leave out its openings."""
        scene = self.homes.load(name, problems)
        return dataclasses.replace(scene, plan=without_openings(scene.plan))


@dataclass(frozen=True)
class ForeignScenes(DerivedScenes):
    """Photographs of generated homes in plans of other buildings; poses are those of other cameras."""

    variant: ClassVar[str] = "asked in plans of other buildings"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene, and another building with the scene's photographs."""
        own = self.homes.load(name, problems)
        prefix, _, number = name.rpartition("-")
        other = self.homes.load(f"{prefix}-{int(number) + 1:0{len(number)}d}", problems)
        kind = int(number) % _KINDS
        plan = other.plan
        cameras = [
            dataclasses.replace(camera, photographs=photographed.photographs)
            for camera, photographed in zip(other.cameras, own.cameras, strict=False)
        ]
        if kind == _KINDS - 1:
            plan = office_plan(np.random.default_rng([_OFFICE_SEED, int(number)]))
            middle = np.mean(plan.rooms[0].polygon_m, axis=0)
            cameras = [dataclasses.replace(camera, position_m=middle, room_index=0) for camera in cameras]
        if kind == 1 or int(number) % (2 * _KINDS) == _KINDS - 1:
            plan = without_openings(plan)
        return dataclasses.replace(own, plan=plan, cameras=tuple(cameras))
