"""Interface of all data sets for training and evaluation.

A `Dataset` lists scenes by split and loads one at a time; a `Scene` is a floor plan with its cameras; a `Camera` is a
true pose with its photographs. Photographs are decoded on demand; `FilePhotograph` is one in a file.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError

from lalaloc_core.errors import DatasetError, InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.dataset_names import Split
from lalaloc_core.photograph.spheres import PhotographLimits, read_sphere


@dataclass(frozen=True, order=True)
class Appearance:
    """Appearance of a room in a photograph; None if unknown."""

    furniture: str | None = None
    lighting: str | None = None

    def __str__(self) -> str:
        return "/".join(part for part in (self.furniture, self.lighting) if part is not None) or "as photographed"


@runtime_checkable
class DatasetPhotograph(Protocol):
    """Sphere that is read on demand.

    It can have `facts`, names of what makes it hard to localise, such as "open_door" or "near_wall".
    """

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        ...

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Return the distance (m) along each pixel's ray, furniture included; NaN without a reading."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """True pose with its photographs; the heading is that of their centre column, and names are unique in a scene."""

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
        """Return a photograph of a camera."""
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


_MM_PER_M = 1000.0


@dataclass(frozen=True, kw_only=True)
class FilePhotograph:
    """Sphere in a file.

    Attributes:
        scene, room: place of the photograph, for errors.
        depth_path: 16-bit PNG with millimetres along each pixel's ray, 0 without a reading; None for no depth.
        size: required (height, width) of both files; None accepts any whole sphere.
    """

    path: Path
    scene: str
    room: str
    depth_path: Path | None = None
    size: tuple[int, int] | None = None

    def content(self) -> bytes:
        """Return the file."""
        return self._read(self.path)

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        content = self.content()
        limits = PhotographLimits() if self.size is None else PhotographLimits(min_height=self.size[0])
        try:
            return read_sphere(content, height=height, width=width, limits=limits)
        except InvalidPhotographError as error:
            raise self._error(str(error), self.path) from error

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Return the distance (m) along each pixel's ray; NaN without a reading."""
        if self.depth_path is None:
            raise self._error("the data set has no depth", self.path)
        content = self._read(self.depth_path)
        try:
            with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
                if not image.mode.startswith("I"):
                    raise self._error(f"depth has mode {image.mode}; a 16-bit grey PNG is required", self.depth_path)
                depth_mm = np.asarray(image)
        except UnidentifiedImageError as error:
            raise self._error("depth is not a PNG picture", self.depth_path) from error
        except (OSError, SyntaxError, Image.DecompressionBombError) as error:
            raise self._error(f"depth is damaged: {error}", self.depth_path) from error
        return np.where(depth_mm == 0, np.nan, depth_mm / _MM_PER_M)

    def _read(self, path: Path) -> bytes:
        """Return a file of the required size, which its header tells before any pixel is decoded."""
        try:
            content = path.read_bytes()
        except OSError as error:
            raise self._error(f"cannot be read: {error.strerror}", path) from error
        if self.size is None:
            return content
        try:
            with Image.open(io.BytesIO(content)) as image:
                width, height = image.size
        except UnidentifiedImageError as error:
            raise self._error("not a readable picture", path) from error
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise self._error(f"damaged: {error}", path) from error
        if (height, width) != self.size:
            raise self._error(
                f"the picture is {width} x {height}; this data set requires {self.size[1]} x {self.size[0]}", path
            )
        return content

    def _error(self, reason: str, path: Path) -> DatasetError:
        return DatasetError(reason, scene=self.scene, room=self.room, path=path)
