"""What every data set looks like to training and evaluation, whatever its files are.

A `Dataset` lists scenes by split and loads one at a time; a `Scene` is a floor plan with the cameras that stood in it;
a `Camera` is a true pose with its photographs. Nothing is decoded before it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
# What each format is called on the command line and in words.
DATASET_FORMATS = {
    "structured3d": "Structured3D",
    "zind": "ZInD",
    "own": "own data",
    "annotated": "annotated photographs",
}


@dataclass(frozen=True, order=True)
class Appearance:
    """How a room looked when it was photographed; None where a data set does not tell.

    Attributes:
        furniture: "empty", "simple" or "full".
        lighting: "cold", "raw" or "warm".
    """

    furniture: str | None = None
    lighting: str | None = None

    def __str__(self) -> str:
        return "/".join(part for part in (self.furniture, self.lighting) if part is not None) or "as photographed"


@runtime_checkable
class Photograph(Protocol):
    """A panorama that can be read."""

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """RGB pixels at the wanted size."""
        ...

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Distance (m) along each pixel's ray to what was seen, furniture included; NaN where there is no reading.

        Raises:
            DatasetError: the data set has no depth.
        """
        ...


@runtime_checkable
class Described(Protocol):
    """A photograph of which it is known what makes it hard, beyond what its appearance tells.

    Attributes:
        facts: names of what holds for it, such as "open_door" or "near_wall"; worked out when asked for.
    """

    @property
    def facts(self) -> frozenset[str]: ...


def facts_of_photograph(photograph: Photograph | None) -> frozenset[str]:
    """What holds for a photograph; nothing where its data set does not tell, or where there is none."""
    return photograph.facts if isinstance(photograph, Described) else frozenset()


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A place where photographs were taken.

    Attributes:
        name: unique within its scene.
        position_m: (x, y) in the plan frame, inside room number `room_index`.
        heading: azimuth of the photographs' centre column, radians.
        camera_height_m: over the floor.
        photographs: by how the room looked.
    """

    name: str
    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    camera_height_m: float
    photographs: Mapping[Appearance, Photograph]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A floor plan and the cameras that stood in it."""

    name: str
    plan: FloorPlan
    cameras: tuple[Camera, ...]

    def photograph(self, camera: Camera, appearance: Appearance) -> Photograph:
        """One photograph of a camera.

        Raises:
            DatasetError: this camera took none like that.
        """
        found = camera.photographs.get(appearance)
        if found is None:
            known = ", ".join(str(one) for one in sorted(camera.photographs, key=str)) or "none"
            raise DatasetError(f"no photograph '{appearance}', there are: {known}", scene=self.name, room=camera.name)
        return found


@runtime_checkable
class Dataset(Protocol):
    """Scenes by split; small enough to be sent to worker processes.

    Attributes:
        description: what results on it are to be called, such as "Structured3D".
        appearances: every appearance that its cameras were photographed in, the usual query first.
    """

    @property
    def description(self) -> str: ...

    @property
    def appearances(self) -> Sequence[Appearance]: ...

    def scenes(self, split: Split) -> Sequence[str]:
        """Names of the scenes of a split, in order."""
        ...

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read one scene.

        Args:
            problems: cameras that cannot be used are left out and their errors appended here; without it the first
                such error is raised.

        Raises:
            DatasetError: the floor plan cannot be read, or a camera where `problems` is None.
        """
        ...


def load_scenes(dataset: Dataset, names: Iterable[str], problems: list[DatasetError] | None = None) -> Iterator[Scene]:
    """Load scenes one after another.

    Args:
        problems: scenes and cameras that cannot be used are left out and their errors appended here.

    Raises:
        DatasetError: the first of them, where `problems` is None.
    """
    for name in names:
        try:
            yield dataset.load(name, problems)
        except DatasetError as error:
            if problems is None:
                raise
            problems.append(error)
