"""Interface of all data sets for training and evaluation.

A `Dataset` lists scenes by split and loads one at a time; a `Scene` is a floor plan with its cameras; a `Camera` is a
true pose with its photographs. Photographs are decoded on demand.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.dataset_names import Split


@dataclass(frozen=True, order=True)
class Appearance:
    """Appearance of a room in a photograph; None if unknown."""

    furniture: str | None = None
    lighting: str | None = None

    def __str__(self) -> str:
        return "/".join(part for part in (self.furniture, self.lighting) if part is not None) or "as photographed"


@runtime_checkable
class DatasetPhotograph(Protocol):
    """Sphere that is read on demand."""

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        ...

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Return the distance (m) along each pixel's ray, furniture included; NaN without a reading."""
        ...


@runtime_checkable
class Described(Protocol):
    """DatasetPhotograph with known facts that make it hard to localise, besides its appearance."""

    @property
    def facts(self) -> frozenset[str]:
        """Names of the facts, such as "open_door" or "near_wall"; computed on demand."""
        ...


def photograph_facts(photograph: DatasetPhotograph | None) -> frozenset[str]:
    """Return the facts of a photograph; empty if they are unknown."""
    return photograph.facts if isinstance(photograph, Described) else frozenset()


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """True pose with its photographs.

    Attributes:
        name: unique within its scene.
        position_m: (x, y) in the plan frame.
        heading: azimuth of the photographs' centre column, radians.
        photographs: by appearance of the room.
    """

    name: str
    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    camera_height_m: float
    photographs: Mapping[Appearance, DatasetPhotograph]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Floor plan with its cameras."""

    name: str
    plan: FloorPlan
    cameras: tuple[Camera, ...]

    def photograph(self, camera: Camera, appearance: Appearance) -> DatasetPhotograph:
        """Return a photograph of a camera.

        Raises:
            DatasetError: the camera has no photograph of this appearance.
        """
        found = camera.photographs.get(appearance)
        if found is None:
            known = ", ".join(str(look) for look in sorted(camera.photographs, key=str)) or "none"
            raise DatasetError(f"no photograph '{appearance}'; available: {known}", scene=self.name, room=camera.name)
        return found


@runtime_checkable
class Dataset(Protocol):
    """Scenes by split; small enough to be sent to worker processes."""

    @property
    def description(self) -> str:
        """Name of the data set in results, such as "Structured3D"."""
        ...

    @property
    def appearances(self) -> Sequence[Appearance]:
        """All appearances of its photographs, the usual one of queries first."""
        ...

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes in order."""
        ...

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read one scene.

        Cameras that cannot be used are left out and their errors appended to `problems`; None raises the first error.

        Raises:
            DatasetError: the floor plan cannot be read, or a camera if `problems` is None.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class HomeScenes:
    """Base of data sets of generated homes with a few cameras each; `split_numbers` has their splits.

    `homes` are per split. With `furniture` None each camera has its own level, which its photograph does not state.
    """

    split_numbers: ClassVar[dict[Split, int]]
    homes: int
    shots_per_home: int = 4
    seed: int = 0
    furniture: Literal["empty", "simple", "full"] | None = "full"

    @property
    def appearances(self) -> Sequence[Appearance]:
        """The only appearance, with the configured furniture level."""
        return (Appearance(self.furniture),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes; empty without such a split."""
        return [f"{split}-{index:05d}" for index in range(self.homes)] if split in self.split_numbers else []

    def home_number(self, name: str) -> tuple[int, int]:
        """Return the numbers of a scene's split and home."""
        split, _, index = name.partition("-")
        number = next((n for known, n in self.split_numbers.items() if known == split), None)
        if number is None or not index.isdecimal():
            raise DatasetError("unknown generated scene; names have the form 'test-00042'", scene=name)
        return number, int(index)


def load_scenes(dataset: Dataset, names: Iterable[str], problems: list[DatasetError] | None = None) -> Iterator[Scene]:
    """Load scenes one after another.

    Scenes and cameras that cannot be used are left out and their errors appended to `problems`; None raises the first.
    """
    for name in names:
        with collect_error(problems):
            yield dataset.load(name, problems)


@contextmanager
def collect_error(problems: list[DatasetError] | None) -> Iterator[None]:
    """Append an error to `problems` instead of raising it; None raises it."""
    try:
        yield
    except DatasetError as error:
        if problems is None:
            raise
        problems.append(error)


class WithoutDepth:
    """Base of photographs that have no depth."""

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Raise an error: there is no depth."""
        raise DatasetError(f"photographs of kind '{type(self).__name__}' have no depth")
