"""Zillow Indoor Dataset (ZInD, Cruz et al. 2021): 360° photographs of real, unfurnished homes.

    ROOT/zind_partition.json
    ROOT/<home>/zind_data.json
    ROOT/<home>/panos/floor_01_partial_room_01_pano_15.jpg

A scene is one floor of a home, "0000/floor_01". ZInD's frame is mirrored: a point (x, y) appears at the image azimuth
atan2(-x, y). Negating x gives the plan frame and reverses rotations, so ZInD's counter-clockwise `rotation` of a
sphere equals its heading. Rings in a layout's `internal` list, inner walls and chimneys, are holes of its room.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.data.assembly import RoomOutline, assemble_plan, is_number, path_below, pose_fault, read_json
from lalaloc_core.learn.data.dataset import Appearance, Camera, FilePhotograph, Scene, Split, collect_error
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening

DATA_FILE = "zind_data.json"
PARTITION_FILE = "zind_partition.json"

# Lists of a layout, and the kinds of their entries in a plan.
_OPENING_LISTS = {"doors": "door", "openings": "passage", "windows": "window"}
_PARTITION_KEYS: dict[Split, str] = {"train": "train", "validation": "val", "test": "test"}


@dataclass(frozen=True)
class Zind:
    """Copy of ZInD, or of a part of it."""

    root: Path
    description = "ZInD"
    appearances = (Appearance(),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return all floors of a split's homes on disk, including those without a metric scale.

        A home whose file cannot be read is listed by its name alone, so that loading it raises the error.
        """
        homes = self._partition.get(_PARTITION_KEYS[split], [])
        return [name for home in homes if (self.root / home).is_dir() for name in self._floors_of(home)]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read a scene; see `Dataset.load`."""
        home, _, floor = name.partition("/")
        folder = path_below(self.root, home)
        if folder is None or "/" in floor:
            raise DatasetError("unknown floor; names have the form '0000/floor_01'", scene=name, path=self.root)
        reader = _FloorReader(name, floor, folder, read_json(folder / DATA_FILE, scene=name))
        return reader.scene(problems)

    @cached_property
    def _partition(self) -> dict[str, list[str]]:
        path = self.root / PARTITION_FILE
        document = read_json(path)
        for key, homes in document.items():
            if key not in _PARTITION_KEYS.values():
                raise DatasetError(f"unknown split '{key}'; known: {', '.join(_PARTITION_KEYS.values())}", path=path)
            if not isinstance(homes, list) or not all(
                isinstance(home, str) and path_below(self.root, home) for home in homes
            ):
                raise DatasetError(f"'{key}' must be a list of names of homes", path=path)
        return document

    def _floors_of(self, home: str) -> list[str]:
        try:
            merger = read_json(self.root / home / DATA_FILE).get("merger")
        except DatasetError:
            return [home]
        return [f"{home}/{floor}" for floor in sorted(merger)] if isinstance(merger, dict) and merger else [home]


@dataclass(frozen=True, kw_only=True)
class _Sphere:
    """Sphere of a floor: its room and name in the file, and its record."""

    complete_room: str
    name: str
    data: Mapping[str, Any]


class _FloorReader:
    """Reader of one floor of a home."""

    def __init__(self, scene: str, floor: str, folder: Path, document: dict[str, Any]) -> None:
        self._scene, self._folder = scene, folder
        self._path = folder / DATA_FILE
        merger, scales = document.get("merger"), document.get("scale_meters_per_coordinate")
        if not isinstance(merger, dict) or not isinstance(scales, dict):
            raise self._error("'merger' and 'scale_meters_per_coordinate' must be objects")
        if not isinstance(merger.get(floor), dict):
            raise self._error(f"no floor '{floor}'; available: {', '.join(sorted(merger)) or 'none'}")
        scale = scales.get(floor)
        if scale is None:
            raise self._error("the floor has no metric scale (scale_meters_per_coordinate is null)")
        if not is_number(scale) or not scale > 0.0:
            raise self._error(f"scale_meters_per_coordinate is {scale!r}; it must be a number above 0")
        self._scale_m = float(scale)
        self._spheres = list(self._walk(merger[floor]))

    def scene(self, problems: list[DatasetError] | None) -> Scene:
        outlines: dict[str, RoomOutline] = {}
        openings: list[DrawnOpening] = []
        faults: list[str] = []
        for sphere in self._spheres:
            if sphere.complete_room not in outlines and sphere.data.get("is_primary") is True:
                layout = sphere.data.get("layout_complete")
                # A small room that was photographed from outside can lack a layout.
                if layout is not None:
                    outlines[sphere.complete_room] = self._outline(sphere, layout, faults)
                    openings += self._openings(sphere, layout, faults)
        plan = assemble_plan(
            self._scene,
            list(outlines.values()),
            path=self._path,
            units="coordinates are multiplied by scale_meters_per_coordinate",
            openings=openings,
            opening_kinds=tuple(_OPENING_LISTS.values()),
        )
        plan = dataclasses.replace(plan, warnings=(*plan.warnings, *faults))
        places = {room.name: index for index, room in enumerate(plan.rooms)}
        rooms = {room: places[outline.name] for room, outline in outlines.items() if outline.name in places}
        cameras = []
        for sphere in self._spheres:
            with collect_error(problems):
                cameras.append(self._camera(sphere, plan, rooms.get(sphere.complete_room)))
        return Scene(name=self._scene, plan=plan, cameras=tuple(cameras))

    def _walk(self, floor: dict[str, Any]) -> Iterator[_Sphere]:
        for complete_room, partial_rooms in sorted(floor.items()):
            for partial_room, spheres in sorted(self._object(partial_rooms, complete_room).items()):
                for pano, data in sorted(self._object(spheres, partial_room).items()):
                    name = f"{partial_room}_{pano}"
                    yield _Sphere(complete_room=complete_room, name=name, data=self._object(data, name))

    def _outline(self, sphere: _Sphere, layout: Any, faults: list[str]) -> RoomOutline:
        vertices = layout.get("vertices") if isinstance(layout, dict) else None
        if not isinstance(vertices, list) or len(vertices) < 3:
            raise self._error("layout_complete has no list 'vertices' of at least three points", sphere.name)
        polygon = self._ring(vertices, "", sphere)
        transform = self._transform(sphere)
        ceiling = self._number(sphere.data, "ceiling_height", sphere)
        label = str(sphere.data.get("label", "")).strip()
        return RoomOutline(
            name=f"{label} {sphere.complete_room}".strip(),
            polygon_m=transform.to_plan_m(polygon),
            holes_m=tuple(map(transform.to_plan_m, self._holes(sphere, layout, faults))),
            ceiling_height_m=ceiling * transform.unit_m,
            type=room_type_from_label(label),
        )

    def _holes(
        self, sphere: _Sphere, layout: Mapping[str, Any], faults: list[str]
    ) -> Iterator[Float[np.ndarray, "n 2"]]:
        rings = layout.get("internal", [])
        if not isinstance(rings, list):
            faults.append(f"{sphere.name}: 'internal' is left out; it is not a list of rings")
            return
        for number, ring in enumerate(rings):
            if not isinstance(ring, list) or len(ring) < 3:
                faults.append(f"{sphere.name}: ring {number} of 'internal' is left out; it has no three points")
                continue
            try:
                yield self._ring(ring, f"ring {number} of 'internal', ", sphere)
            except DatasetError as error:
                faults.append(f"{sphere.name}: ring {number} of 'internal' is left out; {error.reason}")

    def _ring(self, vertices: list[Any], where: str, sphere: _Sphere) -> Float[np.ndarray, "n 2"]:
        return np.array([self._pair(vertex, f"{where}vertex {k}", sphere) for k, vertex in enumerate(vertices)])

    def _openings(self, sphere: _Sphere, layout: Mapping[str, Any], faults: list[str]) -> Iterator[DrawnOpening]:
        """Yield the doors, passages and windows of a layout: triples of start, end, and heights of sill and head."""
        transform = self._transform(sphere)
        camera = self._number(sphere.data, "camera_height", sphere)
        for key, kind in _OPENING_LISTS.items():
            flat = layout.get(key, [])
            if not isinstance(flat, list) or len(flat) % 3:
                faults.append(f"{sphere.name}: '{key}' is left out; it is not a list of triples")
                continue
            for number in range(0, len(flat), 3):
                try:
                    start, end, heights = (
                        self._pair(flat[number + k], f"{key} {number // 3}", sphere) for k in range(3)
                    )
                except DatasetError as error:
                    faults.append(f"{sphere.name}: an entry of '{key}' is left out; {error.reason}")
                    continue
                yield DrawnOpening(
                    kind=kind,
                    line_m=transform.to_plan_m(np.array([start, end])),
                    sill_m=max(0.0, (camera + heights[0]) * transform.unit_m),
                    head_m=(camera + heights[1]) * transform.unit_m,
                )

    def _camera(self, sphere: _Sphere, plan: FloorPlan, room_index: int | None) -> Camera:
        if room_index is None:
            raise self._error(
                f"the room '{sphere.complete_room}' has no usable layout_complete in a primary sphere", sphere.name
            )
        transform = self._transform(sphere)
        position_m = transform.to_plan_m(np.zeros((1, 2)))[0]
        height_m = self._number(sphere.data, "camera_height", sphere) * transform.unit_m
        fault = pose_fault(plan, room_index, position_m, height_m)
        if fault is None and sphere.data.get("is_inside") is False:
            fault = f"the sphere was taken outside its room '{plan.rooms[room_index].name}' (is_inside is false)"
        if fault is not None:
            raise self._error(fault, sphere.name)
        image_path = sphere.data.get("image_path")
        path = path_below(self._folder, image_path) if isinstance(image_path, str) else None
        if path is None:
            raise self._error(f"image_path is {image_path!r}; it must be a path below the home's folder", sphere.name)
        photograph = FilePhotograph(path=path, scene=self._scene, room=sphere.name)
        return Camera(
            name=sphere.name,
            position_m=position_m,
            room_index=room_index,
            heading=transform.heading,
            camera_height_m=height_m,
            photographs={Appearance(): photograph},
        )

    def _transform(self, sphere: _Sphere) -> _Transform:
        found = sphere.data.get("floor_plan_transformation")
        if not isinstance(found, dict):
            raise self._error("has no object 'floor_plan_transformation'", sphere.name)
        return _Transform(
            translation=np.array(self._pair(found.get("translation"), "translation", sphere)),
            rotation_deg=self._number(found, "rotation", sphere, positive=False),
            scale=self._number(found, "scale", sphere),
            scale_m=self._scale_m,
        )

    def _number(self, data: Mapping[str, Any], key: str, sphere: _Sphere, *, positive: bool = True) -> float:
        value = data.get(key)
        if not is_number(value) or (positive and not value > 0.0):
            limit = "a number above 0" if positive else "a number"
            raise self._error(f"{key} is {value!r}; it must be {limit}", sphere.name)
        return float(value)

    def _pair(self, value: Any, key: str, sphere: _Sphere) -> tuple[float, float]:
        if not isinstance(value, list) or len(value) != 2 or not all(map(is_number, value)):
            raise self._error(f"{key} is {str(value)[:80]}; it must be two numbers", sphere.name)
        return float(value[0]), float(value[1])

    def _object(self, value: Any, key: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self._error(f"'{key}' must be an object, not {type(value).__name__}")
        return value

    def _error(self, reason: str, sphere: str | None = None) -> DatasetError:
        return DatasetError(reason, scene=self._scene, room=sphere, path=self._path)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Transform:
    """Transform from a sphere's frame, in camera heights, to the floor's frame and the plan frame.

    Attributes:
        translation: position of the camera in floor coordinates.
        rotation_deg: rotation, counter-clockwise in the floor's mirrored frame.
        scale: floor coordinates per camera height.
        scale_m: metres per floor coordinate.
    """

    translation: Float[np.ndarray, "2"]
    rotation_deg: float
    scale: float
    scale_m: float

    @property
    def unit_m(self) -> float:
        """Metres per unit of the sphere's own frame."""
        return self.scale * self.scale_m

    @property
    def heading(self) -> float:
        return heading_from_degrees(self.rotation_deg)

    def to_plan_m(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        angle = math.radians(self.rotation_deg)
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        floor = self.scale * points @ turn.T + self.translation
        return self.scale_m * floor * np.array([-1.0, 1.0])
