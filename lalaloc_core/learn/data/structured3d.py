"""Structured3D (Zheng et al. 2020), the paper's data set: 3,500 synthetic homes with photorealistic spheres.

    ROOT/scene_00000/annotation_3d.json
    ROOT/scene_00000/2D_rendering/<room>/panorama/camera_xyz.txt
    ROOT/scene_00000/2D_rendering/<room>/panorama/{empty,simple,full}/rgb_{cold,raw,warm}light.png, depth.png

The centre column of every sphere looks along the world's +y, so all headings are 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, DatasetError
from lalaloc_core.learn.data.assembly import is_number, pose_fault, read_json
from lalaloc_core.learn.data.dataset import Appearance, Camera, DatasetPhotograph, FilePhotograph, Scene, collect_error
from lalaloc_core.learn.data.structured3d_annotation import Annotation, read_annotation
from lalaloc_core.learn.dataset_names import Split

# Scene numbers of the official splits.
OFFICIAL: dict[Split, range] = {"train": range(3000), "validation": range(3000, 3250), "test": range(3250, 3500)}

# "Some scenes had corrupted data" (paper, section 5), as listed in the authors' published code.
EXCLUDED_BY_PAPER: dict[Split, tuple[int, ...]] = {
    "train": (
        *(278, 335, 379, 683, 1192, 1212, 1753, 1840, 1852, 1855, 2025),
        *(2110, 2205, 2209, 2223, 2309, 2339, 2357, 2401, 2593, 2956),
    ),
    "validation": (3086, 3117, 3121, 3239),
    "test": (3307,),
}


def scene_numbers(split: Split) -> tuple[int, ...]:
    """Return the numbers of a split's scenes without those excluded by the paper: 2979, 246 and 249 remain."""
    excluded = set(EXCLUDED_BY_PAPER[split])
    return tuple(number for number in OFFICIAL[split] if number not in excluded)


ANNOTATION_FILE = "annotation_3d.json"
RENDERING_FOLDER = "2D_rendering"
SYNTHETIC_FILE = "synthetic.json"
# (height, width) of the data set's own spheres.
SPHERE_SIZE = (512, 1024)
FURNITURE = ("full", "simple", "empty")
LIGHTING = ("warm", "raw", "cold")

_SCENE_NAME = re.compile(r"scene_(\d{5})")
_MM_PER_M = 1000.0


def scene_name(number: int) -> str:
    """Return the name of a scene's folder."""
    return f"scene_{number:05d}"


@dataclass(frozen=True, kw_only=True)
class Synthetic:
    """Content of `synthetic.json`, which marks generated scenes in Structured3D's layout."""

    format: Literal[1]
    seed: int
    height: int
    width: int
    textures: str | None = None


@dataclass(frozen=True)
class Structured3D:
    """Copy of Structured3D or a part of it, or generated scenes in its layout.

    Scenes excluded by the paper are not in the splits, see `EXCLUDED_BY_PAPER`.
    """

    root: Path
    appearances = tuple(Appearance(furniture, lighting) for furniture, lighting in product(FURNITURE, LIGHTING))

    @cached_property
    def synthetic(self) -> Synthetic | None:
        """Settings of generated scenes; None for Structured3D itself."""
        path = self.root / SYNTHETIC_FILE
        if not path.exists():
            return None
        try:
            found: Synthetic = build_config(Synthetic, read_json(path), path=SYNTHETIC_FILE)
        except ConfigError as error:
            raise DatasetError(str(error), path=path) from error
        if found.height < 1 or found.width != 2 * found.height:
            raise DatasetError(
                f"spheres of {found.width} x {found.height}; they must be twice as wide as high", path=path
            )
        return found

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return "Structured3D" if self.synthetic is None else f"synthetic scenes (seed {self.synthetic.seed})"

    @property
    def sphere_size(self) -> tuple[int, int]:
        """Required (height, width) of every sphere."""
        return SPHERE_SIZE if self.synthetic is None else (self.synthetic.height, self.synthetic.width)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes on disk."""
        names = {path.name for path in _folders(self.root)}
        return [name for name in map(scene_name, scene_numbers(split)) if name in names]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read a scene; see `Dataset.load`."""
        if not _SCENE_NAME.fullmatch(name):
            raise DatasetError("unknown scene; names have the form 'scene_03250'", scene=name, path=self.root)
        annotation = read_annotation(self.root / name / ANNOTATION_FILE, name)
        cameras = []
        folders = _folders(self.root / name / RENDERING_FOLDER)
        for folder in sorted(folders, key=lambda path: (int(path.name) if path.name.isdecimal() else -1, path.name)):
            # Some rooms have perspective pictures only.
            if not (folder / "panorama").is_dir():
                continue
            with collect_error(problems):
                cameras.append(self._camera(annotation, name, folder.name, folder / "panorama"))
        return Scene(name=name, plan=annotation.plan, cameras=tuple(cameras))

    def _camera(self, annotation: Annotation, scene: str, room: str, folder: Path) -> Camera:
        path = folder / "camera_xyz.txt"
        x_m, y_m, z_m = (value / _MM_PER_M for value in _read_three(path, scene, room))
        position_m = np.array([x_m, y_m])
        floors = annotation.floors.get(room)
        if not floors:
            why = "has no room with this ID" if floors is None else "has this room, but it is below the minimum area"
            raise DatasetError(f"{ANNOTATION_FILE} {why}", scene=scene, room=room, path=folder)
        faults = {floor: pose_fault(annotation.plan, floor.room_index, position_m, z_m - floor.z_m) for floor in floors}
        floor = next((floor for floor in floors if faults[floor] is None), None)
        if floor is None:
            raise DatasetError(
                f"{faults[floors[0]]} (the file's numbers are read as millimetres)", scene=scene, room=room, path=path
            )
        return Camera(
            name=room,
            position_m=position_m,
            room_index=floor.room_index,
            heading=0.0,
            camera_height_m=z_m - floor.z_m,
            photographs=self._photographs(scene, room, folder),
        )

    def _photographs(self, scene: str, room: str, folder: Path) -> Mapping[Appearance, DatasetPhotograph]:
        found: dict[Appearance, DatasetPhotograph] = {}
        for furniture in FURNITURE:
            level = folder / furniture
            for lighting in LIGHTING:
                path, depth_path = level / f"rgb_{lighting}light.png", level / "depth.png"
                if path.exists():
                    found[Appearance(furniture, lighting)] = FilePhotograph(
                        path=path, scene=scene, room=room, depth_path=depth_path, size=self.sphere_size
                    )
        return found


def _read_three(path: Path, scene: str, room: str) -> tuple[float, float, float]:
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        raise DatasetError(f"cannot be read: {error.strerror}", scene=scene, room=room, path=path) from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"not a text file: {error}", scene=scene, room=room, path=path) from error
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(is_number(value) for value in values):
        raise DatasetError(
            f"holds '{text.strip()[:80]}'; three numbers (millimetres) are required", scene=scene, room=room, path=path
        )
    return values[0], values[1], values[2]


def _folders(folder: Path) -> list[Path]:
    """Return the folders in one; none if it does not exist."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return [path for path in paths if not path.name.startswith(".") and path.is_dir()]
