"""Spheres in metric plans that others made: path-traced rooms, one plan each, and views of a whole house.

    ROOT/<seed>.json, .jpg   room, openings and camera (metres); seeds divisible by five validate, the others train
    ROOT/views.json          poses of spheres in the plans that it names (native format); all validate

As annotated photographs (`annotated`), they train encoders and measure them by azimuth.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.conventions import OPENING_CLASSES, heading_from_degrees, wrap_angle
from lalaloc_core.errors import DatasetError, InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, ClassSpan
from lalaloc_core.learn.data.assembly import path_below, read_json
from lalaloc_core.learn.data.dataset import Appearance, Camera, FilePhotograph, Scene, Split
from lalaloc_core.learn.data.drawn_rooms import drawn_room
from lalaloc_core.render.sweep import sweep_layouts

VIEWS_FILE = "views.json"
# Every n-th room validates.
_VALIDATING = 5
# Columns in which openings are found.
_COLUMNS = 2048


@dataclass(frozen=True)
class PosedSpheres:
    """Folder of path-traced rooms, or of views of a house."""

    root: Path

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"posed spheres ({self.root.resolve().name})"

    appearances = (Appearance(),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes: seeds of rooms, or files of plans."""
        if (self.root / VIEWS_FILE).exists():
            return list(self._views) if split == "validation" else []
        wanted = {"train": False, "validation": True}.get(split)
        return [name for name in room_names(self.root) if (int(name) % _VALIDATING == 0) == wanted]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read a scene; any fault in it is an error."""
        try:
            return self._house(name) if (self.root / VIEWS_FILE).exists() else self._room(name)
        except (KeyError, TypeError, ValueError, InvalidFloorPlanError) as error:
            raise DatasetError(f"not a scene with poses: {error!r}", scene=name, path=self.root) from error

    @cached_property
    def _views(self) -> Mapping[str, list[dict[str, Any]]]:
        views: dict[str, list[dict[str, Any]]] = {}
        for view in json.loads((self.root / VIEWS_FILE).read_bytes()):
            views.setdefault(view["plan"], []).append(view)
        return views

    def _house(self, name: str) -> Scene:
        path = path_below(self.root, name)
        assert path is not None
        plan = FloorPlan.from_json(path.read_bytes())
        numbers = {room.id: number for number, room in enumerate(plan.rooms)}
        cameras = [
            self._camera(
                view["file"],
                (view["x_m"], view["y_m"], view["camera_height_m"]),
                heading_from_degrees(view["heading_deg"]),
                numbers[view["room"]],
            )
            for view in self._views[name]
        ]
        return Scene(name=name, plan=plan, cameras=tuple(cameras))

    def _room(self, name: str) -> Scene:
        document = read_json(self.root / f"{name}.json")
        x_m, y_m, height_m = document["camera"]
        room = {
            "id": "room",
            "name": document["kind"],
            "type": room_type_from_label(document["kind"]),
            "polygon": document["polygon"],
            "ceiling_height_m": document["height"],
        }
        plan = FloorPlan.from_dict(
            {
                "name": name,
                "rooms": [room],
                "openings": document["openings"],
                "opening_kinds": list(OPENING_CLASSES[1:]),
            }
        )
        camera = self._camera(f"{name}.jpg", (x_m, y_m, height_m), float(wrap_angle(document["heading"])), 0)
        return Scene(name=name, plan=plan, cameras=(camera,))

    def _camera(self, file: str, place_m: tuple[float, float, float], heading: float, room_index: int) -> Camera:
        path = path_below(self.root, file)
        if path is None or not path.is_file():
            raise DatasetError(f"the photograph '{file}' is missing", path=self.root)
        return Camera(
            name=path.stem,
            position_m=np.array(place_m[:2], dtype=np.float64),
            room_index=room_index,
            heading=heading,
            camera_height_m=place_m[2],
            photographs={Appearance(): FilePhotograph(path=path, scene=path.stem, room=file)},
        )


def is_posed(root: Path) -> bool:
    """Return whether a folder has posed spheres."""
    return bool(room_names(root)) or (root / VIEWS_FILE).exists()


def room_names(root: Path) -> list[str]:
    """Return the names of the path-traced rooms in a folder, sorted."""
    return sorted(path.stem for path in root.glob("*.json") if path.stem.isdigit())


def annotated(dataset: PosedSpheres, split: Split) -> list[AnnotatedPhotograph]:
    """Return the photographs of a split as if they were annotated by hand."""
    scenes = map(dataset.load, dataset.scenes(split))
    return [_annotated(scene.plan, camera) for scene in scenes for camera in scene.cameras]


def _annotated(plan: FloorPlan, camera: Camera) -> AnnotatedPhotograph:
    (photograph,) = camera.photographs.values()
    assert isinstance(photograph, FilePhotograph)
    scale = CAMERA_HEIGHT_M / camera.camera_height_m
    room = drawn_room(camera.name, plan, camera.room_index)
    room = room.moved(-camera.position_m).turned(camera.heading).scaled(scale)
    return AnnotatedPhotograph(
        name=camera.name,
        photograph=photograph,
        quality="good",
        outlines=(dataclasses.replace(room, ceiling_height_m=scale * room.ceiling_height_m),),
        class_spans=_class_spans(plan, camera),
    )


def _class_spans(plan: FloorPlan, camera: Camera) -> tuple[ClassSpan, ...]:
    heading, room = np.array([camera.heading]), np.array([camera.room_index])
    place = camera.position_m[None], heading, room
    (kind,) = sweep_layouts(*place, plan.wall_table, _COLUMNS, camera.camera_height_m).kind
    first = np.flatnonzero(kind != np.roll(kind, 1))
    return tuple(
        (OPENING_CLASSES[kind[left]], left / _COLUMNS, right / _COLUMNS)
        for left, right in zip(first, np.roll(first, -1), strict=True)
        if kind[left]
    )
