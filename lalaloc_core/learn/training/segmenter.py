"""Unlabelled photographs of real rooms, whose walls and openings a segmenter predicts.

The segmenter is a TensorFlow Lite file for perspective pictures with ADE20K's 31 most frequent classes, such as those
of mlcommons/mobile_open. Two values are derived by azimuth: doors and windows, and the angle at which the floor or the
ceiling ends at a wall, which gives the wall's distance in camera heights.
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

# Height (pixels) of its spheres, and height and width of its views.
SPHERE_ROWS = 512
_VIEWS = 8
_FIELD_OF_VIEW_DEG = 95.0
# Class numbers.
_WALL, _FLOOR, _CEILING, _WINDOW, _DOOR, _CURTAIN, _RUG = 1, 4, 6, 9, 15, 19, 29
_OUTSIDE = (3, 5, _WINDOW)  # sky, tree
# Classes that bound a floor or ceiling at the end of the room; furniture does not.
_BOUNDING = (_WALL, 2, _DOOR, _WINDOW, _CURTAIN)  # building
# Range and step of the elevations (degrees).
_REACH_DEG, _STEP_DEG = 45.0, 0.25
# Elevations (degrees) in which a column's pixels are counted, and the share for a probability of 1.
_DOOR_BETWEEN_DEG = (-35, 5)
_WINDOW_BETWEEN_DEG = (-15, 15)
_CERTAIN_SHARE = 0.35
# Minimum degrees of floor or ceiling and of wall beside a line, share of wall, and minimum angle from the horizon.
_CLEAR_DEG, _CLEAR_SHARE, _FROM_HORIZON_DEG = 3.0, 0.8, 3.0
# A ceiling is flat if this many columns show both lines, with this maximum median deviation of its log height.
_COLUMNS_WITH_BOTH, _FLATNESS = 8, 0.08

Segment = Callable[[UInt8[np.ndarray, "h w 3"]], Int[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class SegmenterReading:
    """Predictions of a sphere by column.

    `openings` are probabilities of door and window. `log_distance` is that of the wall in camera heights; NaN where it
    is not visible.
    """

    openings: Float[np.ndarray, "w 2"]
    log_distance: Float[np.ndarray, "w"]


def read_walls_and_openings(sphere: UInt8[np.ndarray, "h w 3"], segment: Segment, width: int) -> SegmenterReading:
    """Predict the walls and openings of a sphere in `width` columns."""
    elevation_deg = np.arange(-_REACH_DEG, _REACH_DEG, _STEP_DEG) + 0.5 * _STEP_DEG
    classes = _class_map(sphere, segment, np.radians(elevation_deg), width)
    return SegmenterReading(_openings(classes, elevation_deg), _walls(classes, elevation_deg))


def _openings(kind: Int[np.ndarray, "r w"], elevation_deg: Float[np.ndarray, "r"]) -> Float[np.ndarray, "w 2"]:
    """Return the probabilities of door and window by column."""
    shares = []
    for classes, (low, high) in (((_DOOR,), _DOOR_BETWEEN_DEG), (_OUTSIDE, _WINDOW_BETWEEN_DEG)):
        rows = (elevation_deg > low) & (elevation_deg < high)
        shares.append(np.clip(np.isin(kind[rows], classes).mean(axis=0) / _CERTAIN_SHARE, 0.0, 1.0))
    both = np.stack(shares, axis=1)
    return (both / np.maximum(both.sum(axis=1, keepdims=True), 1.0)).astype(np.float32)


def _walls(kind: Int[np.ndarray, "r w"], elevation_deg: Float[np.ndarray, "r"]) -> Float[np.ndarray, "w"]:
    """Return the log distance of the wall by column, in camera heights.

    Columns whose floor line is hidden by furniture use the ceiling line. It gives the distance in units of the ceiling
    height, which the other columns provide if the ceiling is flat.
    """
    wall = np.isin(kind, _BOUNDING)
    by_floor = _line_distance(np.isin(kind, (_FLOOR, _RUG)), wall)
    by_ceiling = _line_distance((kind == _CEILING)[::-1], wall[::-1])
    both = np.isfinite(by_floor) & np.isfinite(by_ceiling)
    log_height = by_floor[both] - by_ceiling[both]
    if both.sum() >= _COLUMNS_WITH_BOTH:
        height = np.median(log_height)
        if np.median(np.abs(log_height - height)) <= _FLATNESS:
            by_floor = np.where(np.isfinite(by_floor), by_floor, by_ceiling + height)
    return by_floor.astype(np.float32)


def _line_distance(surface: Bool[np.ndarray, "r w"], wall: Bool[np.ndarray, "r w"]) -> Float[np.ndarray, "w"]:
    """Return the log of 1 / tan of the angle from the horizon at which a floor ends at a wall; NaN without a line.

    `surface` has floor pixels from 45 degrees below the horizon upwards, or ceiling pixels from 45 degrees above it
    downwards, and `wall` the wall pixels in the same order.
    """
    clear = round(_CLEAR_DEG / _STEP_DEG)
    end = np.argmin(surface, axis=0)
    below_deg = _REACH_DEG - end * _STEP_DEG
    rows = np.minimum(end + np.arange(clear)[:, None], len(wall) - 1)
    met = np.take_along_axis(wall, rows, axis=0).mean(axis=0) > _CLEAR_SHARE
    valid = met & (end >= clear) & (below_deg >= _FROM_HORIZON_DEG)
    return np.where(valid, -np.log(np.tan(np.radians(np.maximum(below_deg, _FROM_HORIZON_DEG)))), np.nan)


def _class_map(
    sphere: UInt8[np.ndarray, "h w 3"], segment: Segment, elevation: Float[np.ndarray, "r"], width: int
) -> Int[np.ndarray, "r {width}"]:
    """Return the class of every direction, from the view whose centre is nearest in azimuth."""
    rows, columns = sphere.shape[:2]
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * TWO_PI
    nearest = np.round(azimuth / (TWO_PI / _VIEWS)).astype(int)
    kind = np.zeros((len(elevation), width), dtype=np.int64)
    for view in np.unique(nearest):
        centre, chosen = view * TWO_PI / _VIEWS, nearest == view
        size, focal = SPHERE_ROWS, 0.5 * SPHERE_ROWS / math.tan(math.radians(_FIELD_OF_VIEW_DEG / 2.0))
        pixel = np.arange(size) + 0.5 - 0.5 * size
        pixel_azimuth = centre + np.arctan2(pixel, focal)[None, :]
        pixel_elevation = np.arctan2(-pixel[:, None], np.hypot(pixel, focal)[None, :])
        column = np.floor((pixel_azimuth / TWO_PI + 0.5) * columns).astype(int) % columns
        row = np.clip(np.floor((0.5 - pixel_elevation / math.pi) * rows).astype(int), 0, rows - 1)
        classes = segment(sphere[row, np.broadcast_to(column, row.shape)])
        relative = azimuth[chosen] - centre
        x = np.floor(np.tan(relative) * focal + 0.5 * size).astype(int)
        y = np.floor(-np.tan(elevation)[:, None] / np.cos(relative) * focal + 0.5 * size).astype(int)
        kind[:, chosen] = classes[np.clip(y, 0, size - 1), np.clip(x, 0, size - 1)[None, :]]
    return kind


def load_segmenter(path: Path) -> Segment:
    """Load a segmenter as a function of pictures of 512 x 512 pixels."""
    try:
        # Only in the extra 'trunk', so a type checker may not find it.
        from ai_edge_litert.interpreter import Interpreter  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError("--teacher needs the package ai-edge-litert; install the extra 'trunk'") from error
    try:
        interpreter = Interpreter(str(path), num_threads=1)
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"teacher '{path}' cannot be run: {error}") from error
    (model_input,), (model_output,) = interpreter.get_input_details(), interpreter.get_output_details()
    shape, dtype = tuple(model_input["shape"]), np.dtype(model_input["dtype"])
    if shape != (1, SPHERE_ROWS, SPHERE_ROWS, 3) or dtype != np.uint8:
        raise ConfigError(f"teacher '{path}' takes {shape} {dtype}; (1, 512, 512, 3) uint8 is required")

    def segment(picture: np.ndarray) -> np.ndarray:
        interpreter.set_tensor(model_input["index"], np.ascontiguousarray(picture[None]))
        interpreter.invoke()
        return interpreter.get_tensor(model_output["index"]).reshape(SPHERE_ROWS, SPHERE_ROWS)

    return segment
