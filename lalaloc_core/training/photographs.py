"""Real photographs without labels, and what a segmenter that was trained on real rooms sees in them.

The teacher is a TensorFlow Lite file of the classes of ADE20K's 31 most frequent ones, such as the segmenters of
mlcommons/mobile_open; it wants perspective pictures. What is learnt from it are doors and windows by azimuth alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import ConfigError, DatasetError, InvalidPanoramaError
from lalaloc_core.panorama.images import read_panorama

# Height (pixels) that photographs are read at for the teacher.
_READ_ROWS = 512
_VIEWS = 8
_FIELD_OF_VIEW_DEG = 95.0
# Classes of the teacher's maps.
_DOOR = 15
_OUTSIDE = (3, 5, 9)  # sky, tree, windowpane
# Elevations (degrees) between which a column's pixels are counted, and the share that makes a door or window certain.
_DOOR_BETWEEN_DEG = (-35, 5)
_WINDOW_BETWEEN_DEG = (-15, 15)
_CERTAIN_SHARE = 0.35

Segment = Callable[[UInt8[np.ndarray, "h w 3"]], Int[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs with a teacher's opinion.

    Attributes:
        images: (n, h, w, 3) RGB bytes.
        taught: (n, w, 2) probabilities of door and window by column of the pictures.
    """

    images: UInt8[Tensor, "n h w 3"]
    taught: Float[Tensor, "n w 2"]

    def draw(
        self, count: int, columns: int, generator: torch.Generator
    ) -> tuple[UInt8[Tensor, "{count} h w 3"], Float[Tensor, "{count} {columns} 2"]]:
        """Some photographs, each turned and mirrored at random, and what is taught of them in so many columns."""
        width = self.images.shape[2]
        images, taught = [], []
        for index in torch.randint(len(self.images), (count,), generator=generator).tolist():
            shift, mirrored = (int(torch.randint(n, (1,), generator=generator)) for n in (width, 2))
            image, told = self.images[index].roll(shift, 1), self.taught[index].roll(shift, 0)
            images.append(image.flip(1) if mirrored else image)
            taught.append(told.flip(0) if mirrored else told)
        return torch.stack(images), torch.stack(taught).unflatten(1, (columns, -1)).mean(dim=2)


def load_photographs(folder: Path, teacher: Path, height: int, width: int) -> Photographs:
    """Read the panoramas (`*.jpg`, `*.png`) of a folder and let the teacher look at each.

    Raises:
        ConfigError: the teacher cannot be run.
        DatasetError: there are none, or one cannot be read.
    """
    paths = sorted(path for pattern in ("*.jpg", "*.jpeg", "*.png") for path in folder.glob(pattern))
    if not paths:
        raise DatasetError("no photographs (*.jpg, *.jpeg, *.png)", path=folder)
    segment = _segmenter(teacher)
    images, taught = [], []
    for path in paths:
        try:
            content = path.read_bytes()
            large = read_panorama(content, height=_READ_ROWS, width=2 * _READ_ROWS)
            images.append(read_panorama(content, height=height, width=width))
        except (OSError, InvalidPanoramaError) as error:
            raise DatasetError(f"cannot be read: {error}", path=path) from error
        taught.append(_seen(large, segment, width))
    return Photographs(torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(taught)))


def _seen(panorama: UInt8[np.ndarray, "h w 3"], segment: Segment, width: int) -> Float[np.ndarray, "{width} 2"]:
    """Probabilities of door and window by column."""
    low = min(_DOOR_BETWEEN_DEG[0], _WINDOW_BETWEEN_DEG[0])
    elevation_deg = np.arange(low, max(_DOOR_BETWEEN_DEG[1], _WINDOW_BETWEEN_DEG[1])) + 0.5
    kind = _class_map(panorama, segment, np.radians(elevation_deg), width)
    seen = []
    for classes, (least, most) in (((_DOOR,), _DOOR_BETWEEN_DEG), (_OUTSIDE, _WINDOW_BETWEEN_DEG)):
        rows = (elevation_deg > least) & (elevation_deg < most)
        seen.append(np.clip(np.isin(kind[rows], classes).mean(axis=0) / _CERTAIN_SHARE, 0.0, 1.0))
    both = np.stack(seen, axis=1)
    return (both / np.maximum(both.sum(axis=1, keepdims=True), 1.0)).astype(np.float32)


def _class_map(
    panorama: UInt8[np.ndarray, "h w 3"], segment: Segment, elevation: Float[np.ndarray, "r"], width: int
) -> Int[np.ndarray, "r {width}"]:
    """The class of every direction, by the view whose centre is nearest in azimuth."""
    rows, columns = panorama.shape[:2]
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * TWO_PI
    nearest = np.round(azimuth / (TWO_PI / _VIEWS)).astype(int)
    kind = np.zeros((len(elevation), width), dtype=np.int64)
    for view in np.unique(nearest):
        centre, chosen = view * TWO_PI / _VIEWS, nearest == view
        size, focal = _READ_ROWS, 0.5 * _READ_ROWS / math.tan(math.radians(_FIELD_OF_VIEW_DEG / 2.0))
        pixel = np.arange(size) + 0.5 - 0.5 * size
        seen_azimuth = centre + np.arctan2(pixel, focal)[None, :]
        seen_elevation = np.arctan2(-pixel[:, None], np.hypot(pixel, focal)[None, :])
        column = np.floor((seen_azimuth / TWO_PI + 0.5) * columns).astype(int) % columns
        row = np.clip(np.floor((0.5 - seen_elevation / math.pi) * rows).astype(int), 0, rows - 1)
        classes = segment(panorama[row, np.broadcast_to(column, row.shape)])
        relative = azimuth[chosen] - centre
        x = np.floor(np.tan(relative) * focal + 0.5 * size).astype(int)
        y = np.floor(-np.tan(elevation)[:, None] / np.cos(relative) * focal + 0.5 * size).astype(int)
        kind[:, chosen] = classes[np.clip(y, 0, size - 1), np.clip(x, 0, size - 1)[None, :]]
    return kind


def _segmenter(path: Path) -> Segment:
    """The teacher as a function of pictures of 512 x 512 pixels."""
    try:
        # Of the extra 'trunk' alone, so a type checker may not find it.
        from ai_edge_litert.interpreter import Interpreter  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError("a teacher needs the package ai-edge-litert; install the extra 'trunk'") from error
    try:
        interpreter = Interpreter(str(path), num_threads=1)
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"teacher '{path}' cannot be run: {error}") from error
    (given,), (answered,) = interpreter.get_input_details(), interpreter.get_output_details()
    if tuple(given["shape"]) != (1, _READ_ROWS, _READ_ROWS, 3) or given["dtype"] != np.uint8:
        raise ConfigError(f"teacher '{path}' takes {given['shape']} {given['dtype']}, not (1, 512, 512, 3) bytes")

    def segment(picture: np.ndarray) -> np.ndarray:
        interpreter.set_tensor(given["index"], np.ascontiguousarray(picture[None]))
        interpreter.invoke()
        return interpreter.get_tensor(answered["index"]).reshape(_READ_ROWS, _READ_ROWS)

    return segment
