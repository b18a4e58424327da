"""Generated homes with other photographs or in other plans.

Calibration (`lalaloc_core.evaluate.calibrate`) needs degraded photographs and small length errors, because renderings
of exact plans fit better than photographs do. Photographs of other homes, of no room, upside down or cropped are its
unknown places, and so are photographs in other buildings: a plain room fits somewhere in most. Copies of a home in one
plan differ only in the positions of their doors.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, DatasetPhotograph, Scene, Split, WithoutDepth
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, camera_seed
from lalaloc_core.learn.synth.augmentation import jittered, optics, stretched_images
from lalaloc_core.render.sweep import sweep_layouts

# Standard deviation of the log ratio between photographed and planned lengths, along two axes.
_LENGTH_ERROR = 0.1
# Strength of the photometric changes, 1 as in training.
_STRENGTH = 1.0


def _disturbed(camera: Camera) -> Camera:
    seed = camera_seed(camera)
    photographs = {look: DisturbedPhotograph(photograph, seed) for look, photograph in camera.photographs.items()}
    return dataclasses.replace(camera, photographs=photographs)


@dataclass(frozen=True, eq=False)
class DisturbedPhotograph(WithoutDepth):
    """Photograph with small length errors and the effects of a real camera."""

    photograph: DatasetPhotograph
    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        generator = torch.Generator().manual_seed(self.seed)
        factors = torch.exp(_LENGTH_ERROR * torch.randn(1, 2, generator=generator))
        image = stretched_images(torch.from_numpy(self.photograph.image(height, width))[None], factors)
        image = optics(jittered(image, _STRENGTH, generator), _STRENGTH, generator)
        return image[0].round().to(torch.uint8).numpy()


# One of this many photographs shows no room, one is upside down, and in every second home one is cropped.
_EVERY = 4
# Rows and columns of a sphere in the view of an ordinary camera.
_CROP = slice(0.3, 0.7), slice(0.25, 0.5)


def _mismatch(own: Scene, homes: GeneratedScenes) -> Scene:
    """Give the cameras photographs of the next home, or photographs that cannot be localised.

    Poses and heights are those of the home's own cameras, and unrelated to the photographs.
    """
    number, other = _next_home(own, homes)
    cameras = [
        dataclasses.replace(camera, photographs=_mismatched(camera, other.cameras[k % len(other.cameras)], k, number))
        for k, camera in enumerate(own.cameras)
    ]
    return dataclasses.replace(own, cameras=tuple(cameras))


def _next_home(own: Scene, homes: GeneratedScenes) -> tuple[int, Scene]:
    """Return the number of a home, and the home after it."""
    prefix, _, number = own.name.rpartition("-")
    return int(number), homes.load(f"{prefix}-{int(number) + 1:0{len(number)}d}")


def _mismatched(camera: Camera, other: Camera, k: int, home: int) -> dict[Appearance, DatasetPhotograph]:
    """Return the photographs of the k-th camera of a home."""
    if k % _EVERY == _EVERY - 3 and home % 2:
        return {look: Cropped(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 2:
        return {look: UpsideDown(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 1:
        seed = camera_seed(camera)
        return dict.fromkeys(camera.photographs, OutdoorPhotograph(seed))
    return dict(zip(camera.photographs, other.photographs.values(), strict=True))


@dataclass(frozen=True, eq=False)
class UpsideDown:
    """DatasetPhotograph of a camera mounted upside down: the sphere rotated by half a turn."""

    photograph: DatasetPhotograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        return np.ascontiguousarray(self.photograph.image(height, width)[::-1, ::-1])

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Return the distance (m) along each pixel's ray."""
        return np.ascontiguousarray(self.photograph.depth_m()[::-1, ::-1])


@dataclass(frozen=True, eq=False)
class Cropped(WithoutDepth):
    """View of an ordinary camera, stretched to the size of a sphere."""

    photograph: DatasetPhotograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        whole = self.photograph.image(height, width)
        rows, columns = (
            np.linspace(part.start * size, part.stop * size, size, endpoint=False).astype(int)
            for part, size in zip(_CROP, (height, width), strict=True)
        )
        return np.ascontiguousarray(whole[rows][:, columns])


@dataclass(frozen=True)
class OutdoorPhotograph(WithoutDepth):
    """Ground under a sky in random colours, sometimes the same colour, like a lens against a wall."""

    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        rng = np.random.default_rng(self.seed)
        sky, ground = rng.uniform(20.0, 250.0, (2, 3))
        if rng.random() < 0.4:
            ground = sky
        up = np.linspace(1.0, -1.0, height)[:, None, None]
        haze = rng.uniform(0.0, 0.5)
        colour = np.where(up > 0.0, sky, ground) * (1.0 - haze * np.abs(up))
        grain = rng.normal(0.0, rng.uniform(0.0, 10.0), (height, width, 3))
        return np.clip(colour + grain, 0.0, 255.0).astype(np.uint8)


# Copies, and their gap (m), not a multiple of the grid step, so that the grid has another offset in each copy.
_COPIES, _APART_M = 4, 3.17
# Share of the doors seen by a camera that are moved in the other copies, besides one per camera.
_MOVED_SHARE = 0.5
# Minimum number of azimuths, of all azimuths, of a visible door: about 6°.
_SEEN_COLUMNS, _COLUMNS = 2, 128
# Distance (m) of doors from corners and other openings, step of positions along a wall, and maximum distance of an
# opening from the wall that contains it.
_CLEAR_M, _STEP_M, _MAX_THICKNESS_M = 0.15, 0.1, 0.5


def _copy(own: Scene, homes: GeneratedScenes) -> Scene:
    """Repeat the plan several times in a row; one random copy per home is photographed.

    In the other copies some doors are moved within their room, at least one of those that each camera sees, so every
    photograph identifies its copy. Doors without a free position are removed. Cameras that see no door are left out.
    """
    rng = np.random.default_rng([homes.seed, zlib.crc32(own.name.encode())])
    whole = int(rng.integers(_COPIES))
    x_min, _, x_max, _ = own.plan.bounds_m
    step_m = x_max - x_min + _APART_M
    document = own.plan.to_dict()
    seen = [(camera, _seen_doors(own.plan, camera)) for camera in own.cameras]
    seen = [(camera, doors) for camera, doors in seen if doors]
    rooms, openings = [], []
    for copy in range(_COPIES):
        by_m = copy * step_m
        rooms += [_moved_room(room, copy, by_m) for room in document["rooms"]]
        kept = document.get("openings", [])
        if copy != whole:
            kept = _with_moved_doors(own.plan, kept, seen, rng)
        openings += [_moved_opening(opening, copy, by_m) for opening in kept]
    plan = FloorPlan.from_dict(
        {**document, "rooms": rooms, "openings": openings, "opening_kinds": sorted(own.plan.opening_kinds)}
    )
    shift_m, first_room = np.array([whole * step_m, 0.0]), whole * len(own.plan.rooms)
    cameras = tuple(
        dataclasses.replace(camera, position_m=camera.position_m + shift_m, room_index=camera.room_index + first_room)
        for camera, _ in seen
    )
    return dataclasses.replace(own, plan=plan, cameras=cameras)


def _seen_doors(plan: FloorPlan, camera: Camera) -> list[int]:
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


def _visible_kinds(plan: FloorPlan, camera: Camera) -> UInt8[np.ndarray, "w"]:
    place = camera.position_m[None], np.zeros(1), np.array([camera.room_index])
    return sweep_layouts(*place, plan.wall_table, _COLUMNS, camera.camera_height_m).kind[0]


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


def _replace_plan(own: Scene, homes: GeneratedScenes) -> Scene:
    """Show the photographs in the plan of another building; poses are those of other cameras."""
    number, other = _next_home(own, homes)
    kind = number % _KINDS
    plan = other.plan
    cameras = [
        dataclasses.replace(camera, photographs=photographed.photographs)
        for camera, photographed in zip(other.cameras, own.cameras, strict=False)
    ]
    if kind == _KINDS - 1:
        plan = office_plan(np.random.default_rng([_OFFICE_SEED, number]))
        middle = np.mean(plan.rooms[0].polygon_m, axis=0)
        cameras = [dataclasses.replace(camera, position_m=middle, room_index=0) for camera in cameras]
    if kind == 1 or number % (2 * _KINDS) == _KINDS - 1:
        plan = without_openings(plan)
    return dataclasses.replace(own, plan=plan, cameras=tuple(cameras))


# Changes of a generated scene by the name of the generator, each with its part of the data set's description.
CHANGES: dict[str, tuple[str, Callable[[Scene, GeneratedScenes], Scene]]] = {
    "copies": (f"{_COPIES} copies that differ in their doors", _copy),
    "disturbed": ("disturbed", lambda own, _: dataclasses.replace(own, cameras=tuple(map(_disturbed, own.cameras)))),
    "foreign": ("asked in plans of other buildings", _replace_plan),
    "mismatched": ("asked with photographs of others", _mismatch),
    "unopened": ("plans without openings", lambda own, _: dataclasses.replace(own, plan=without_openings(own.plan))),
}


@dataclass(frozen=True)
class AlteredScenes:
    """Generated homes after one of `CHANGES`."""

    homes: GeneratedScenes
    change: str

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"{self.homes.description}, {CHANGES[self.change][0]}"

    @property
    def appearances(self) -> Sequence[Appearance]:
        """Appearances of the generated homes."""
        return self.homes.appearances

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes."""
        return self.homes.scenes(split)

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene and change it."""
        return CHANGES[self.change][1](self.homes.load(name, problems), self.homes)
