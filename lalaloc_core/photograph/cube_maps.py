"""Cube maps: recognised by their faces, whose edges continue each other, and converted to spheres."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import column_azimuths, row_elevations

# Faces of a cube map, as (row, column, half turns) each.
FRONT, RIGHT, BACK, LEFT, UP, DOWN = range(6)
# Layouts in rows and columns.
_CROSSES = ((3, 4), (4, 3))
_GRIDS = ((2, 3), (3, 2), (1, 6), (6, 1))
# Side (pixels) of judged faces, and the relative deviation of a ratio of sides.
_SIDE = 64
_TOLERANCE = 0.01
# Empty cells of a cross: largest spread of grey levels, and difference between cells.
_MAX_SPREAD, _MAX_DIFFERENCE = 5.0, 10.0
# Edges: ratio of the difference across a border to that between lines next to it, up to which they continue each other
# and from which they do not; least shares of continued edges and of broken borders.
_CONTINUED, _BROKEN = 2.5, 4.0
_MIN_CONTINUED, _MIN_BROKEN = 0.8, 0.25


@dataclass(frozen=True, kw_only=True)
class CubeMap:
    """A cube map: the name of its layout, and its faces in the order of `FRONT`… if the layout tells them."""

    name: str
    faces: tuple[tuple[int, int, int], ...] | None = None


def find_cube(pixels: UInt8[np.ndarray, "h w 3"]) -> CubeMap | None:
    """Return the layout of a cube map; None for any other picture."""
    height, width = pixels.shape[:2]
    for rows, columns in (*_CROSSES, *_GRIDS):
        if abs(width * rows - height * columns) > max(_TOLERANCE * width * rows, float(rows + columns)):
            continue
        cells = cut_cells(pixels, rows, columns, _SIDE)
        faces = _faces_of_cross(cells) if (rows, columns) in _CROSSES else None
        if faces is not None:
            return CubeMap(name=f"a cross of {columns} x {rows} faces", faces=faces)
        if (rows, columns) in _GRIDS and _is_cube(cells):
            return CubeMap(name=f"{columns} x {rows} faces")
    return None


def cut_cells(
    pixels: UInt8[np.ndarray, "h w 3"], rows: int, columns: int, side: int
) -> UInt8[np.ndarray, "{rows} {columns} {side} {side} 3"]:
    """Return the cells of a picture, scaled to squares."""
    size = columns * side, rows * side
    even = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return even.reshape(rows, side, columns, side, 3).transpose(0, 2, 1, 3, 4)


def to_sphere(
    pixels: UInt8[np.ndarray, "h w 3"], faces: tuple[tuple[int, int, int], ...], height: int, width: int
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Return the sphere of a cross of faces; its centre is that of the front face."""
    rows, columns = 1 + max(face[0] for face in faces), 1 + max(face[1] for face in faces)
    side = max(pixels.shape[1] // columns, 1)
    cells = cut_cells(pixels, rows, columns, side)
    azimuth, elevation = np.meshgrid(column_azimuths(width), row_elevations(height))
    x, y = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
    z = np.sin(elevation)
    # Right and down within each face, relative to the distance to it.
    axes = {FRONT: (y, x, -z), RIGHT: (x, -y, -z), BACK: (-y, -x, -z), LEFT: (-x, y, -z), UP: (z, x, y)}
    axes[DOWN] = (-z, x, -y)
    nearest = np.argmax(np.stack([axes[face][0] for face in range(len(faces))]), axis=0)
    sphere = np.zeros((height, width, 3), np.uint8)
    for face, (row, column, turns) in enumerate(faces):
        ahead, right, down = axes[face]
        shown = np.rot90(cells[row, column], 2 * turns)
        place = [(axis / np.maximum(ahead, 0.1) + 1.0) * 0.5 * side - 0.5 for axis in (right, down)]
        taken = cv2.remap(
            np.ascontiguousarray(shown),
            place[0].astype(np.float32),
            place[1].astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        sphere[nearest == face] = taken[nearest == face]
    return sphere


def _faces_of_cross(cells: UInt8[np.ndarray, "r c s s 3"]) -> tuple[tuple[int, int, int], ...] | None:
    """Return the faces of a cross: a band of four faces, with one above and one below it, and empty cells."""
    rows, columns = cells.shape[:2]
    values = cells.reshape(rows, columns, -1, 3).astype(np.float32)
    is_empty = values.std(axis=2).max(axis=-1) < _MAX_SPREAD
    empty = values.mean(axis=2)[is_empty]
    if len(empty) != 6 or np.ptp(empty, axis=0).max() > _MAX_DIFFERENCE:
        return None
    if rows == 3:
        if is_empty[1].any() or (is_empty[0] != is_empty[2]).any():
            return None
        front = int(np.argmin(is_empty[0]))
        band = [(1, (front + step) % 4, 0) for step in range(4)]
        return (*band, (0, front, 0), (2, front, 0))
    if is_empty[:, 1].any() or is_empty[1].any():
        return None
    return (1, 1, 0), (1, 2, 0), (3, 1, 1), (1, 0, 0), (0, 1, 0), (2, 1, 0)


def _is_cube(cells: UInt8[np.ndarray, "r c s s 3"]) -> bool:
    """Return whether the edges of six faces continue each other, and not only those of neighbours in the picture."""
    rows, columns = cells.shape[:2]
    faces = cells.reshape(-1, *cells.shape[2:]).astype(np.float32)
    edges, steps = _edges(faces)
    ratio = _differences(edges) / (np.minimum(steps[:, None], steps[None, :]) + 1.0)
    own = np.repeat(np.arange(6), 4)
    ratio[own[:, None] == own[None, :]] = np.inf
    index = np.arange(6).reshape(rows, columns)
    pairs = [(4 * a + 1, 4 * b + 0) for a, b in zip(index[:, :-1].ravel(), index[:, 1:].ravel(), strict=True)]
    pairs += [(4 * a + 3, 4 * b + 2) for a, b in zip(index[:-1].ravel(), index[1:].ravel(), strict=True)]
    broken = np.mean([ratio[a, b] > _BROKEN for a, b in pairs])
    continued = np.mean(ratio.min(axis=1) < _CONTINUED)
    return bool(broken >= _MIN_BROKEN and continued >= _MIN_CONTINUED)


def _edges(faces: Float[np.ndarray, "6 s s 3"]) -> tuple[Float[np.ndarray, "24 s 3"], Float[np.ndarray, "24"]]:
    """Return left, right, top and bottom edge of each face, and their mean difference from the line beside."""
    lines = [
        (face, beside)
        for picture in faces
        for face, beside in (
            (picture[:, 0], picture[:, 1]),
            (picture[:, -1], picture[:, -2]),
            (picture[0], picture[1]),
            (picture[-1], picture[-2]),
        )
    ]
    edges = np.stack([edge for edge, _ in lines])
    return edges, np.abs(edges - np.stack([beside for _, beside in lines])).mean(axis=(1, 2))


def _differences(edges: Float[np.ndarray, "n s 3"]) -> Float[np.ndarray, "n n"]:
    """Return the mean difference of each edge from each other one, in the direction that fits better."""
    return np.minimum(*(np.abs(edges[:, None] - other[None]).mean(axis=(2, 3)) for other in (edges, edges[:, ::-1])))
