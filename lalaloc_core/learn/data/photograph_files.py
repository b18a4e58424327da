"""Photographs in files, opened on demand."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError

from lalaloc_core.errors import DatasetError, InvalidPhotographError
from lalaloc_core.photograph.spheres import PhotographLimits, read_sphere

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
        """Return the file.

        Raises:
            DatasetError: the file is missing, or not of the data set's size.
        """
        content = self._read(self.path)
        if self.size is not None:
            self._check_size(self.path, content)
        return content

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size.

        Raises:
            DatasetError: the file is missing, damaged, not a sphere, or not of the data set's size.
        """
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
        if self.size is not None:
            self._check_size(self.depth_path, content)
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
        try:
            return path.read_bytes()
        except OSError as error:
            raise self._error(f"cannot be read: {error.strerror}", path) from error

    def _check_size(self, path: Path, content: bytes) -> None:
        """Check the size in the file's header before any pixel is decoded."""
        try:
            with Image.open(io.BytesIO(content)) as image:
                width, height = image.size
        except UnidentifiedImageError as error:
            raise self._error("not a readable picture", path) from error
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise self._error(f"damaged: {error}", path) from error
        if (height, width) != self.size and self.size is not None:
            raise self._error(
                f"the picture is {width} x {height}; this data set requires {self.size[1]} x {self.size[0]}", path
            )

    def _error(self, reason: str, path: Path) -> DatasetError:
        return DatasetError(reason, scene=self.scene, room=self.room, path=path)
