"""Plans with several copies of a home that differ only in the positions of their doors."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.learn.data.synthetic.generated import DerivedScenes
from lalaloc_core.render.profile import render_layout

# Copies, and their gap (m), not a multiple of the grid step, so that the grid has another offset in each copy.
_COPIES, _APART_M = 4, 3.17
# Share of the doors seen by a camera that are moved in the other copies, besides one per camera.
_MOVED_SHARE = 0.5
# Minimum number of azimuths, of all azimuths, of a visible door: about 6°.
_SEEN_COLUMNS, _COLUMNS = 2, 128
# Distance (m) of doors from corners and other openings, step of positions along a wall, and maximum distance of an
# opening from the wall that contains it.
_CLEAR_M, _STEP_M, _MAX_THICKNESS_M = 0.15, 0.1, 0.5


@dataclass(frozen=True)
class CopiedScenes(DerivedScenes):
    """Generated homes as plans of several copies in a row; one random copy per home is photographed.

    In the other copies some doors are moved within their room, at least one of those that each camera sees, so every
    photograph identifies its copy. Doors without a free position are removed. Cameras that see no door are left out.
    """

    variant: ClassVar[str] = f"{_COPIES} copies that differ in their doors"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene and copy it."""
        scene = self.homes.load(name, problems)
        rng = np.random.default_rng([self.homes.seed, zlib.crc32(name.encode())])
        own = int(rng.integers(_COPIES))
        x_min, _, x_max, _ = scene.plan.bounds_m
        step_m = x_max - x_min + _APART_M
        document = scene.plan.to_dict()
        seen = [(camera, _seen_doors(scene.plan, camera)) for camera in scene.cameras]
        seen = [(camera, doors) for camera, doors in seen if doors]
        rooms, openings = [], []
        for copy in range(_COPIES):
            by_m = copy * step_m
            rooms += [_moved_room(room, copy, by_m) for room in document["rooms"]]
            kept = document.get("openings", [])
            if copy != own:
                kept = _with_moved_doors(scene.plan, kept, seen, rng)
            openings += [_moved_opening(opening, copy, by_m) for opening in kept]
        plan = FloorPlan.from_dict(
            {**document, "rooms": rooms, "openings": openings, "opening_kinds": sorted(scene.plan.opening_kinds)}
        )
        shift_m, first_room = np.array([own * step_m, 0.0]), own * len(scene.plan.rooms)
        cameras = tuple(
            dataclasses.replace(
                camera, position_m=camera.position_m + shift_m, room_index=camera.room_index + first_room
            )
            for camera, _ in seen
        )
        return dataclasses.replace(scene, plan=plan, cameras=cameras)


def _seen_doors(plan: FloorPlan, camera: Camera) -> list[int]:
    """Return the indices of the doors that a camera sees."""
    kinds = _visible_kinds(plan, camera)
    document = plan.to_dict()
    openings = document.get("openings", [])
    seen = []
    for index, opening in enumerate(openings):
        if opening["kind"] == "door":
            without = FloorPlan.from_dict({**document, "openings": openings[:index] + openings[index + 1 :]})
            if np.sum(_visible_kinds(without, camera) != kinds) >= _SEEN_COLUMNS:
                seen.append(index)
    return seen


def _visible_kinds(plan: FloorPlan, camera: Camera) -> Int[np.ndarray, "w"]:
    room, heading = np.array([camera.room_index]), np.zeros(1)
    view = render_layout(camera.position_m[None], heading, room, plan.geometry, _COLUMNS, camera.camera_height_m)
    return view.kind[0]


def _with_moved_doors(
    plan: FloorPlan, openings: list[dict[str, Any]], seen: Sequence[tuple[Camera, list[int]]], rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Return the openings of a copy: some doors seen by cameras are moved within the camera's room."""
    moving: dict[int, int] = {}
    for camera, doors in seen:
        chosen = int(rng.choice(doors))
        moving |= {door: camera.room_index for door in doors if door == chosen or rng.random() < _MOVED_SHARE}
    placed = dict(enumerate(openings))
    for index, room in moving.items():
        line = _free_line(plan.rooms[room].polygon_m, openings[index], list(placed.values()), rng)
        del placed[index]
        if line is not None:
            placed[index] = {**openings[index], "line": line, "rooms": [plan.rooms[room].id]}
    return [placed[index] for index in sorted(placed)]


def _free_line(
    polygon_m: Float[np.ndarray, "v 2"], door: dict[str, Any], openings: list[dict[str, Any]], rng: np.random.Generator
) -> list[list[float]] | None:
    """Draw a free position for a door on a room's walls; None if there is none."""
    width_m = float(np.linalg.norm(np.subtract(*door["line"])))
    lines = np.array([opening["line"] for opening in openings])
    free = []
    for start, end in zip(polygon_m, np.roll(polygon_m, -1, axis=0), strict=True):
        length_m = float(np.linalg.norm(end - start))
        along = (end - start) / length_m
        positions = (lines - start) @ along
        apart = np.abs((lines - start) @ np.array([-along[1], along[0]])).max(axis=1)
        taken = np.sort(positions[apart < _MAX_THICKNESS_M], axis=1)
        for first in np.arange(_CLEAR_M, length_m - width_m - _CLEAR_M, _STEP_M):
            last = first + width_m
            if not np.any((taken[:, 0] < last + _CLEAR_M) & (taken[:, 1] > first - _CLEAR_M)):
                free.append([(start + first * along).tolist(), (start + last * along).tolist()])
    return free[int(rng.integers(len(free)))] if free else None


def _moved_room(room: dict[str, Any], copy: int, by_m: float) -> dict[str, Any]:
    lists = {key: [_moved(points, by_m) for points in room[key]] for key in ("holes", "walls") if key in room}
    return {**room, **lists, "id": f"{room['id']}-copy-{copy}", "polygon": _moved(room["polygon"], by_m)}


def _moved_opening(opening: dict[str, Any], copy: int, by_m: float) -> dict[str, Any]:
    rooms = {"rooms": [f"{room}-copy-{copy}" for room in opening["rooms"]]} if "rooms" in opening else {}
    return {**opening, **rooms, "line": _moved(opening["line"], by_m)}


def _moved(points: list[list[float]], by_m: float) -> list[list[float]]:
    return [[x + by_m, y] for x, y in points]
