"""What a segmenter that was trained on photographs of real rooms sees in a panorama.

It is a TensorFlow Lite file of the classes of ADE20K's 31 most frequent ones, such as the segmenters of
mlcommons/mobile_open; it wants perspective pictures. Two things are taken from its maps by azimuth: doors and windows,
and where the floor or the ceiling ends at a wall, which is the wall's distance in camera heights.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import ConfigError

# Height (pixels) of the panoramas that are shown to it, and height and width of its views.
PANORAMA_ROWS = 512
_VIEWS = 8
_FIELD_OF_VIEW_DEG = 95.0
# Its classes.
_WALL, _FLOOR, _CEILING, _WINDOW, _DOOR, _CURTAIN, _RUG = 1, 4, 6, 9, 15, 19, 29
_OUTSIDE = (3, 5, _WINDOW)  # sky, tree
# What ends a floor or a ceiling where the room ends; furniture stands in front of that.
_BOUNDING = (_WALL, 2, _DOOR, _WINDOW, _CURTAIN)  # building
# Elevations (degrees) that are looked at, finely enough for lines.
_REACH_DEG, _STEP_DEG = 45.0, 0.25
# Elevations (degrees) between which a column's pixels are counted, and the share that makes a door or window certain.
_DOOR_BETWEEN_DEG = (-35, 5)
_WINDOW_BETWEEN_DEG = (-15, 15)
_CERTAIN_SHARE = 0.35
# A line lies between so many degrees of floor or ceiling and of a wall, and so far from the horizon at least.
_CLEAR_DEG, _CLEAR_SHARE, _FROM_HORIZON_DEG = 3.0, 0.8, 3.0
# A ceiling is flat where so many columns show both lines and tell heights that differ by this much in the median.
_COLUMNS_WITH_BOTH, _FLATNESS = 8, 0.08

Segment = Callable[[UInt8[np.ndarray, "h w 3"]], Int[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class SegmenterReading:
    """What is seen in a panorama, by column.

    Attributes:
        openings: (w, 2) probabilities of door and window.
        log_distance: (w,) log of the distance of the room's wall in camera heights; nan where it is not seen.
    """

    openings: Float[np.ndarray, "w 2"]
    log_distance: Float[np.ndarray, "w"]


def read_walls_and_openings(panorama: UInt8[np.ndarray, "h w 3"], segment: Segment, width: int) -> SegmenterReading:
    """What a segmenter sees in a panorama, in so many columns."""
    elevation_deg = np.arange(-_REACH_DEG, _REACH_DEG, _STEP_DEG) + 0.5 * _STEP_DEG
    kind = _class_map(panorama, segment, np.radians(elevation_deg), width)
    return SegmenterReading(_openings(kind, elevation_deg), _walls(kind, elevation_deg))


def _openings(kind: Int[np.ndarray, "r w"], elevation_deg: Float[np.ndarray, "r"]) -> Float[np.ndarray, "w 2"]:
    """Probabilities of door and window by column."""
    seen = []
    for classes, (least, most) in (((_DOOR,), _DOOR_BETWEEN_DEG), (_OUTSIDE, _WINDOW_BETWEEN_DEG)):
        rows = (elevation_deg > least) & (elevation_deg < most)
        seen.append(np.clip(np.isin(kind[rows], classes).mean(axis=0) / _CERTAIN_SHARE, 0.0, 1.0))
    both = np.stack(seen, axis=1)
    return (both / np.maximum(both.sum(axis=1, keepdims=True), 1.0)).astype(np.float32)


def _walls(kind: Int[np.ndarray, "r w"], elevation_deg: Float[np.ndarray, "r"]) -> Float[np.ndarray, "w"]:
    """Log distance of the wall by column, in camera heights.

    Where furniture hides the end of the floor, the end of the ceiling tells the distance in units of the ceiling's
    height, which other columns tell, if the ceiling is flat.
    """
    wall = np.isin(kind, _BOUNDING)
    by_floor = _ends(np.isin(kind, (_FLOOR, _RUG)), wall)
    by_ceiling = _ends((kind == _CEILING)[::-1], wall[::-1])
    both = np.isfinite(by_floor) & np.isfinite(by_ceiling)
    log_height = by_floor[both] - by_ceiling[both]
    if both.sum() >= _COLUMNS_WITH_BOTH:
        height = np.median(log_height)
        if np.median(np.abs(log_height - height)) <= _FLATNESS:
            by_floor = np.where(np.isfinite(by_floor), by_floor, by_ceiling + height)
    return by_floor.astype(np.float32)


def _ends(surface: Bool[np.ndarray, "r w"], wall: Bool[np.ndarray, "r w"]) -> Float[np.ndarray, "w"]:
    """Log of 1 / tan of the angle from the horizon at which a floor ends at a wall; nan where it does not.

    Args:
        surface: from 45 degrees below the horizon upwards, where the floor is; of a ceiling the other way round.
    """
    clear = round(_CLEAR_DEG / _STEP_DEG)
    end = np.argmin(surface, axis=0)
    below_deg = _REACH_DEG - end * _STEP_DEG
    rows = np.minimum(end + np.arange(clear)[:, None], len(wall) - 1)
    met = np.take_along_axis(wall, rows, axis=0).mean(axis=0) > _CLEAR_SHARE
    told = met & (end >= clear) & (below_deg >= _FROM_HORIZON_DEG)
    return np.where(told, -np.log(np.tan(np.radians(np.maximum(below_deg, _FROM_HORIZON_DEG)))), np.nan)


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
        size, focal = PANORAMA_ROWS, 0.5 * PANORAMA_ROWS / math.tan(math.radians(_FIELD_OF_VIEW_DEG / 2.0))
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


def load_segmenter(path: Path) -> Segment:
    """The segmenter in a file, as a function of pictures of 512 x 512 pixels.

    Raises:
        ConfigError: it cannot be run.
    """
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
    if tuple(given["shape"]) != (1, PANORAMA_ROWS, PANORAMA_ROWS, 3) or given["dtype"] != np.uint8:
        raise ConfigError(f"teacher '{path}' takes {given['shape']} {given['dtype']}, not (1, 512, 512, 3) bytes")

    def segment(picture: np.ndarray) -> np.ndarray:
        interpreter.set_tensor(given["index"], np.ascontiguousarray(picture[None]))
        interpreter.invoke()
        return interpreter.get_tensor(answered["index"]).reshape(PANORAMA_ROWS, PANORAMA_ROWS)

    return segment
