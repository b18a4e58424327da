"""Photographs of real rooms with targets for their walls and openings: annotated, or predicted by teachers.

Three sources give targets. Annotations are exact. A segmenter sees doors and windows, but no passages. An encoder of
spheres sees the whole room, so it reads walls far better than an encoder of views can from a part of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lalaloc_core.bundle import MANIFEST_NAME, Bundle
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI
from lalaloc_core.errors import ConfigError, DatasetError, InvalidPhotographError, install_command
from lalaloc_core.learn.data.annotated import annotation_files
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, read_annotation
from lalaloc_core.learn.data.posed_spheres import PosedSpheres, annotated, is_posed
from lalaloc_core.learn.training.batch_streams import UNKNOWN
from lalaloc_core.learn.training.batches import Photographs
from lalaloc_core.learn.training.warm_start import bundle_weights
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from lalaloc_core.photograph.spheres import read_sphere

# Turns of a sphere whose predictions the teacher averages, each also mirrored.
_TURNS = 8


def load_photographs(
    folders: Sequence[Path], teachers: Sequence[Path], height: int, width: int, shares: Sequence[float] = ()
) -> Photographs:
    """Read the spheres (`*.jpg`, `*.jpeg`, `*.png`) of folders with their targets.

    Spheres with an annotation in one of the folders use that, and of path-traced rooms those that train; the others
    need teachers: a TensorFlow Lite segmenter, a bundle whose encoder of spheres reads them, or both. With both the
    walls and passages are the encoder's, and doors and windows the mean of the two. `shares` are those of each folder
    in what is drawn; empty draws all alike.
    """
    if shares and len(shares) != len(folders):
        raise ConfigError(f"image.photograph_shares has {len(shares)} values for {len(folders)} folders of photographs")
    exact = {folder: _annotated_in(folder) for folder in folders}
    known = {photograph.photograph.path.name for photographs in exact.values() for photograph in photographs}
    parts = []
    for number, (folder, photographs) in enumerate(exact.items()):
        read = [_annotated(photographs, height, width)] if photographs else []
        paths = sorted(path for pattern in ("*.jpg", "*.jpeg", "*.png") for path in folder.glob(pattern))
        if not paths:
            raise DatasetError("no photographs (*.jpg, *.jpeg, *.png)", path=folder)
        # A photograph that another folder annotates needs no teacher; posed spheres that validate must have none.
        others = [] if is_posed(folder) else [path for path in paths if path.name not in known]
        read += [_taught(others, teachers, height, width)] if others else []
        if is_posed(folder) and not read:
            raise DatasetError("its photographs only validate; leave it out of --photographs", path=folder)
        share = shares[number] / max(sum(len(part.weight) for part in read), 1) if shares else 1.0
        parts += [replace(part, weight=part.weight * share) for part in read]
    return Photographs(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Photographs)))


def _annotated_in(folder: Path) -> list[AnnotatedPhotograph]:
    if is_posed(folder):
        return annotated(PosedSpheres(folder), "train")
    return [read_annotation(path) for path in annotation_files(folder)]


def _annotated(photographs: Sequence[AnnotatedPhotograph], height: int, width: int) -> Photographs:
    images = _read([photograph.photograph.path for photograph in photographs], height, width)
    kinds = torch.from_numpy(np.stack([photograph.classes(width) for photograph in photographs]))
    distance = np.stack([photograph.profile_m(0, width) for photograph in photographs]) / CAMERA_HEIGHT_M
    openings = torch.nn.functional.one_hot(kinds, len(OPENING_CLASSES))[..., 1:].float()
    # Code 0 stands for rooms without a type.
    codes = [ROOM_TYPES.index(photograph.outlines[0].room_type) or UNKNOWN for photograph in photographs]
    weight = torch.ones(len(images))
    return Photographs(images, openings, torch.from_numpy(np.log(distance)).float(), torch.tensor(codes), weight)


def _taught(paths: Sequence[Path], teachers: Sequence[Path], height: int, width: int) -> Photographs:
    bundles = [path for path in teachers if (path / MANIFEST_NAME).exists()]
    segmenters = [path for path in teachers if path not in bundles]
    if not teachers or max(len(bundles), len(segmenters)) > 1:
        raise ConfigError(
            f"{len(paths)} photographs without annotation need one segmenter (--teacher FILE), one bundle "
            f"(--teacher DIR), or one of each; {len(segmenters)} and {len(bundles)} are given"
        )
    targets = []
    for path in segmenters:
        segment = load_segmenter(path)
        large = _read(paths, SPHERE_ROWS, 2 * SPHERE_ROWS)
        readings = (read_walls_and_openings(picture.numpy(), segment, width) for picture in large)
        openings, distance = (torch.from_numpy(np.stack(part)) for part in zip(*readings, strict=True))
        openings = torch.cat([openings, torch.full_like(openings[..., :1], torch.nan)], dim=2)
        targets.append((openings, distance))
    for path in bundles:
        encoder = _load_encoder(path)
        spheres = _read(paths, encoder.config.image_height, encoder.config.image_width)
        targets.append(read_by_encoder(encoder, spheres, width))
    openings, log_distance = targets[-1]
    if len(targets) == 2:
        shared = 0.5 * (targets[0][0][..., :2] + openings[..., :2])
        openings = torch.cat([shared, openings[..., 2:]], dim=2)
    images, codes = _read(paths, height, width), torch.full((len(paths),), UNKNOWN)
    return Photographs(images, openings, log_distance, codes, torch.ones(len(paths)))


@torch.no_grad()
def read_by_encoder(
    encoder: TrunkImageEncoder, spheres: UInt8[Tensor, "n h w 3"], width: int
) -> tuple[Float[Tensor, "n w 3"], Float[Tensor, "n w"]]:
    """Return openings and log distances of spheres in `width` columns, over turned and mirrored pictures."""
    openings, distances = [], []
    for mirrored in (False, True):
        for turn in range(_TURNS):
            shift = turn * spheres.shape[2] // _TURNS
            shown = spheres.roll(shift, 2).flip(2) if mirrored else spheres.roll(shift, 2)
            features = encoder(shown, torch.ones(len(spheres)))
            assert features.structure is not None
            share = torch.softmax(features.structure.opening_logits, dim=2)[..., 1:]
            distance = features.walls.likeliest
            if mirrored:
                share, distance = share.flip(1), distance.flip(1)
            back = -turn * distance.shape[1] // _TURNS
            openings.append(share.roll(back, 1))
            distances.append(distance.roll(back, 1))
    repeats = width // distances[0].shape[1]
    mean, median = torch.stack(openings).mean(dim=0), torch.stack(distances).median(dim=0).values
    return mean.repeat_interleave(repeats, dim=1), median.repeat_interleave(repeats, dim=1)


def _load_encoder(folder: Path) -> TrunkImageEncoder:
    start = bundle_weights(Bundle.open(folder), "image")
    config = start.checkpoint.config
    if config.architecture != "trunk":
        raise ConfigError(f"teacher '{folder}' has architecture '{config.architecture}'; 'trunk' is required")
    encoder = TrunkImageEncoder(config.trunk, config.ring)
    start.load_into({"image_encoder": encoder})
    return encoder.eval()


def _read(paths: Sequence[Path], height: int, width: int) -> UInt8[Tensor, "n h w 3"]:
    images = []
    for path in paths:
        try:
            images.append(read_sphere(path.read_bytes(), height=height, width=width))
        except (OSError, InvalidPhotographError) as error:
            raise DatasetError(f"cannot be read: {error}", path=path) from error
    return torch.from_numpy(np.stack(images))


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


def read_walls_and_openings(
    sphere: UInt8[np.ndarray, "h w 3"], segment: Segment, width: int
) -> tuple[Float[np.ndarray, "w 2"], Float[np.ndarray, "w"]]:
    """Return the probabilities of door and window, and the log distance of the wall in camera heights, by column.

    The distance is NaN where the wall is not visible.
    """
    elevation_deg = np.arange(-_REACH_DEG, _REACH_DEG, _STEP_DEG) + 0.5 * _STEP_DEG
    classes = _class_map(sphere, segment, np.radians(elevation_deg), width)
    return _openings(classes, elevation_deg), _walls(classes, elevation_deg)


def _openings(kind: Int[np.ndarray, "r w"], elevation_deg: Float[np.ndarray, "r"]) -> Float[np.ndarray, "w 2"]:
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
        raise ConfigError(f"--teacher needs the package ai-edge-litert; run {install_command('trunk')}") from error
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
