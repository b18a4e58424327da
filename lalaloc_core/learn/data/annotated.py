"""Annotated photographs as a data set: each is localised in galleries, plans of its own room among similar ones."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, is_annotation, read_annotation
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene, Split
from lalaloc_core.learn.data.drawn_rooms import DrawnRoom, drawn_room, plan_of_rooms
from lalaloc_core.learn.data.posed_spheres import PosedSpheres, annotated, room_names
from lalaloc_core.learn.dataset_names import GALLERIES
from lalaloc_core.learn.synth.homes.plans import generate_home

_ROOM_SPLITS: tuple[Split, ...] = ("train", "validation")
_SCENE = re.compile(r"(?P<photograph>.+)-(?P<gallery>\d+)(?P<alternative>-alternative)?")


@dataclass(frozen=True)
class GalleryKey:
    """Key of a scene: the photograph, the number of its gallery, and the outline used for its own room."""

    photograph: str
    gallery: int
    outline: int

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return f"{self.photograph}-{self.gallery}" + ("-alternative" if self.outline else "")

    @classmethod
    def from_scene(cls, name: str) -> GalleryKey | None:
        """Parse a scene's name; return None if it is not the name of a gallery."""
        match = _SCENE.fullmatch(name)
        if match is None:
            return None
        return cls(match["photograph"], int(match["gallery"]), int(match["alternative"] is not None))


@dataclass(frozen=True)
class AnnotatedPhotographs:
    """Folder of annotated photographs, which are all test scenes, or of path-traced rooms, which have the other splits.

    A photograph with an alternative outline has each gallery twice, once per outline, with the same other rooms.
    Photographs of poor quality have no gallery, but their rooms occur in galleries of others.
    """

    root: Path

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"annotated photographs in galleries ({self.root.resolve().name})"

    appearances = (Appearance(),)

    @cached_property
    def photographs(self) -> tuple[AnnotatedPhotograph, ...]:
        """All photographs, sorted by name."""
        photographs = tuple(read_annotation(path) for path in annotation_files(self.root))
        if room_names(self.root):
            photographs += tuple(each for split in _ROOM_SPLITS for each in annotated(PosedSpheres(self.root), split))
        if not photographs:
            raise DatasetError("the folder has no annotated photographs", path=self.root)
        return photographs

    def keys(self, galleries: int = GALLERIES) -> list[GalleryKey]:
        """Return the keys of the scenes: the first gallery of every photograph, then the second ones, and so on."""
        return [
            GalleryKey(photograph.name, gallery, outline)
            for gallery in range(galleries)
            for photograph in self.photographs
            if photograph.counts
            for outline in range(len(photograph.outlines))
        ]

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of the galleries: three of every annotated photograph, one of every path-traced room."""
        if split == "test":
            return [] if room_names(self.root) else [key.scene for key in self.keys()]
        rooms = set(PosedSpheres(self.root).scenes(split) if room_names(self.root) else [])
        return [key.scene for key in self.keys(1) if key.photograph in rooms]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Build the gallery of a scene's name."""
        key = GalleryKey.from_scene(name)
        photograph = next((p for p in self.photographs if key is not None and p.name == key.photograph), None)
        if key is None or photograph is None or key.outline >= len(photograph.outlines):
            raise DatasetError("no such gallery of an annotated photograph", scene=name, path=self.root)
        others = [other.outlines[0] for other in self.photographs if other is not photograph]
        rng = np.random.default_rng([zlib.crc32(photograph.name.encode()), key.gallery])
        own = photograph.outlines[key.outline]
        first = photograph.outlines[0]
        plan, room_index, position_m, heading = build_gallery(own, others, CAMERA_HEIGHT_M, rng, like=first)
        camera = Camera(
            name=photograph.name,
            position_m=position_m,
            room_index=room_index,
            heading=heading,
            camera_height_m=CAMERA_HEIGHT_M,
            photographs={Appearance(): photograph.photograph},
        )
        return Scene(name=name, plan=plan, cameras=(camera,))


def annotation_files(root: Path) -> list[Path]:
    """Return the annotation files of a folder, sorted by name."""
    return [path for path in sorted(root.glob("*.json")) if is_annotation(path)]


GALLERY_ROOMS = 20
# Maximum number of annotated rooms among the others; the rest are generated.
_MAX_DRAWN = 9
# Maximum relative change of size: of annotated rooms to their drawing, of generated rooms to the own room.
_RESCALED = 0.1
# Number of most similar generated rooms from which a gallery draws.
_SIMILAR = 30
_POOL_HOMES = 60
# Seed of homes outside all splits: training, validation and test seeds begin with 0, 1 and 2.
_POOL = 7
_PER_ROW = 5
# Gap between rooms, wider than a wall, so that no door belongs to two rooms.
_GAP_M = 1.0


def build_gallery(
    own: DrawnRoom,
    others: Sequence[DrawnRoom],
    camera_height_m: float,
    rng: np.random.Generator,
    like: DrawnRoom | None = None,
) -> tuple[FloorPlan, int, Float[np.ndarray, "2"], float]:
    """Place a room among similar ones, all aligned with the axes and randomly rotated by quarter turns.

    Returns the plan of `GALLERY_ROOMS` rooms, the index of the own room, the origin of its frame and the heading of +y.

    `own` has the camera at its origin, looking along +y. Of the `others`, those most similar to `like` (default: `own`)
    in size and shape are used, up to `_MAX_DRAWN`, rescaled within `_RESCALED`; the rest are generated rooms of similar
    shape, scaled to the size within the same range.
    """
    like = like or own
    drawn = sorted(others, key=lambda room: _dissimilarity(like, room))[:_MAX_DRAWN]
    generated, shapes = _generated()
    pool = [generated[k] for k in np.argsort(np.abs(shapes - _shape(like)).sum(axis=1), kind="stable")[:_SIMILAR]]
    chosen = rng.choice(len(pool), GALLERY_ROOMS - 1 - len(drawn), replace=False)
    low, high = 1.0 - _RESCALED, 1.0 + _RESCALED
    rooms = [room.scaled(rng.uniform(low, high)) for room in drawn]
    rooms += [pool[k].scaled(like.size_m / pool[k].size_m * rng.uniform(low, high)) for k in chosen]
    rooms = [room.mirrored() if rng.random() < 0.5 else room for room in rooms]
    turns = [0.5 * np.pi * int(rng.integers(4)) - room.main_direction for room in (own, *rooms)]
    turned = [room.turned(turn) for room, turn in zip((own, *rooms), turns, strict=True)]
    order = rng.permutation(GALLERY_ROOMS)
    places = _side_by_side([turned[k] for k in order], rng)
    placed = [turned[k].moved(place) for k, place in zip(order, places, strict=True)]
    room_index = int(np.flatnonzero(order == 0)[0])
    plan = plan_of_rooms(f"gallery of {own.name}", placed, camera_height_m)
    # Azimuth grows clockwise, angles counter-clockwise.
    return plan, room_index, places[room_index], float(wrap_angle(-turns[0]))


@lru_cache(maxsize=1)
def _generated() -> tuple[tuple[DrawnRoom, ...], Float[np.ndarray, "n 2"]]:
    """Return rooms of generated homes with unique names, and their shapes."""
    homes = [generate_home(np.random.default_rng([_POOL, number])) for number in range(_POOL_HOMES)]
    rooms = tuple(
        drawn_room(f"{room.name}, home {number}", home.plan, index)
        for number, home in enumerate(homes)
        for index, room in enumerate(home.plan.rooms)
    )
    return rooms, np.stack([_shape(room) for room in rooms])


def _shape(room: DrawnRoom) -> Float[np.ndarray, "2"]:
    """Return the logs of a room's aspect ratio and of the floor's share of its bounding box."""
    extent_m = room.turned(-room.main_direction).extent_m
    return np.log([extent_m.max() / extent_m.min(), room.size_m**2 / extent_m.prod()])


def _dissimilarity(first: DrawnRoom, second: DrawnRoom) -> float:
    return float(np.abs(_shape(first) - _shape(second)).sum() + abs(np.log(first.size_m / second.size_m)))


def _side_by_side(rooms: Sequence[DrawnRoom], rng: np.random.Generator) -> list[Float[np.ndarray, "2"]]:
    """Return the translations that arrange rooms in rows, with gaps of `_GAP_M` and a little more."""
    moves, top_m = [], 0.0
    for first in range(0, len(rooms), _PER_ROW):
        row = rooms[first : first + _PER_ROW]
        right_m = 0.0
        for room in row:
            # A random offset varies the position of the pose grid in the room.
            corner = np.array([right_m, top_m]) + rng.uniform(0.0, 0.5, 2)
            moves.append(corner - room.polygon_m.min(axis=0))
            right_m = corner[0] + room.extent_m[0] + _GAP_M
        top_m += max(room.extent_m[1] for room in row) + _GAP_M + 0.5
    return moves
