"""Cube maps: recognised by their faces, whose edges continue each other, and converted to spheres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import column_azimuths, row_elevations

# Faces of a cube map: (row, column, quarter turns counter-clockwise that set it upright) each.
Faces = tuple[tuple[int, int, int], ...]
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
# Arrangements: largest ratio that counts, largest mean of the cube's twelve edges, and least quotient of the next best
# arrangement of walls, floor and ceiling and the best one.
_WORST, _MAX_MEAN, _MIN_MARGIN = 6.0, 2.5, 1.25
# The rows of equi-angular cube maps as video sites store them: left, front, right; below, back, above, turned.
_TURNED_ROWS: Faces = ((0, 1, 0), (0, 2, 0), (1, 1, 1), (0, 0, 0), (1, 2, 3), (1, 0, 3))


@dataclass(frozen=True, kw_only=True)
class CubeMap:
    """A cube map.

    Attributes:
        name: its layout.
        faces: its faces in the order of `FRONT`…, if layout or edges tell them.
    """

    name: str
    faces: Faces | None = None

    @property
    def equiangular(self) -> bool:
        """True if pixels are at equal angles, not at equal distances on the cube: only such maps have turned rows."""
        return self.faces == _TURNED_ROWS


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
            faces = arrange_faces(cells)
            kind = "equi-angular, " if faces == _TURNED_ROWS else ""
            return CubeMap(name=f"{kind}{columns} x {rows} faces", faces=faces)
    return None


def cut_cells(
    pixels: UInt8[np.ndarray, "h w 3"], rows: int, columns: int, side: int
) -> UInt8[np.ndarray, "{rows} {columns} {side} {side} 3"]:
    """Return the cells of a picture, scaled to squares."""
    size = columns * side, rows * side
    even = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return even.reshape(rows, side, columns, side, 3).transpose(0, 2, 1, 3, 4)


def to_sphere(
    pixels: UInt8[np.ndarray, "h w 3"], cube: CubeMap, height: int, width: int
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Return the sphere of a cube map whose faces are known; its centre is that of the front face."""
    faces = cube.faces
    assert faces is not None
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
        shown = np.rot90(cells[row, column], turns)
        on_face = [axis / np.maximum(ahead, 0.1) for axis in (right, down)]
        if cube.equiangular:
            on_face = [np.arctan(shift) * (4.0 / np.pi) for shift in on_face]
        place = [(shift + 1.0) * 0.5 * side - 0.5 for shift in on_face]
        taken = cv2.remap(
            np.ascontiguousarray(shown),
            place[0].astype(np.float32),
            place[1].astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        sphere[nearest == face] = taken[nearest == face]
    return sphere


def _faces_of_cross(cells: UInt8[np.ndarray, "r c s s 3"]) -> Faces | None:
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
    return (1, 1, 0), (1, 2, 0), (3, 1, 2), (1, 0, 0), (0, 1, 0), (2, 1, 0)


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


def arrange_faces(cells: UInt8[np.ndarray, "r c s s 3"]) -> Faces | None:
    """Return the faces of a cube map of six cells by the edges that continue each other; None if they leave a doubt.

    Walls are upright in their cells, except in `_TURNED_ROWS`. The front is the wall below which the ceiling's cell is
    upright; another front would turn the sphere only.
    """
    columns = cells.shape[1]
    cell, turn = _arrangements(columns)
    lines = [
        np.rot90(face, turns) for face in cells.reshape(-1, *cells.shape[2:]).astype(np.float32) for turns in range(4)
    ]
    edges, steps = _edges(np.stack(lines))
    ratios = np.stack([_differences_along(edges, other) for other in (edges, edges[:, ::-1])])
    ratios /= np.minimum(steps[:, None], steps[None, :]) + 1.0
    # Edges are numbered by cell, turns, and side of the turned cell.
    face_a, side_a, face_b, side_b, is_reversed = np.array(_cube_edges()).T
    first, second = (
        (4 * cell[:, face] + turn[:, face]) * 4 + side for face, side in ((face_a, side_a), (face_b, side_b))
    )
    means = np.minimum(ratios[is_reversed, first, second], _WORST).mean(axis=1)
    # Among equal floors, an upright one.
    best = int(np.argmin(means + 1e-3 * (turn[:, DOWN] > 0)))
    rivals = means[~_have_walls_of(cell, cell[best])]
    if means[best] > _MAX_MEAN or float(rivals.min()) < _MIN_MARGIN * means[best]:
        return None
    return tuple((int(c) // columns, int(c) % columns, int(t)) for c, t in zip(cell[best], turn[best], strict=True))


@cache
def _arrangements(columns: int) -> tuple[Int[np.ndarray, "n 6"], Int[np.ndarray, "n 6"]]:
    """Return cell and quarter turns of each face, of all arrangements that are tried."""
    every: list[tuple[tuple[int, ...], tuple[int, ...]]] = [
        ((*walls, *poles), (0, 0, 0, 0, 0, below))
        for poles in permutations(range(6), 2)
        for walls in permutations(sorted({*range(6)} - {*poles}))
        for below in range(4)
    ]
    if columns == 3:
        cells = tuple(3 * row + column for row, column, _ in _TURNED_ROWS)
        every.append((cells, tuple(turns for *_, turns in _TURNED_ROWS)))
    return np.array([cell for cell, _ in every]), np.array([turn for _, turn in every])


def _have_walls_of(cell: Int[np.ndarray, "n 6"], best: Int[np.ndarray, "6"]) -> Bool[np.ndarray, "n"]:
    """Return which arrangements have the same ceiling and floor, and the same walls in order from any front."""
    turned = [np.roll(best[:4], step) for step in range(4)]
    return (cell[:, 4:] == best[4:]).all(axis=1) & np.any(
        [(cell[:, :4] == walls).all(axis=1) for walls in turned], axis=0
    )


@cache
def _cube_edges() -> list[tuple[int, int, int, int, int]]:
    """Return the twelve edges of a cube as face and side of both faces, and 1 if their pixels run in opposite ways."""
    x, y, z = np.eye(3, dtype=int)
    axes = {
        FRONT: (y, x, -z),
        RIGHT: (x, -y, -z),
        BACK: (-y, -x, -z),
        LEFT: (-x, y, -z),
        UP: (z, x, y),
        DOWN: (-z, x, -y),
    }
    ends: dict[tuple[int, int], tuple[tuple[int, ...], ...]] = {}
    for face, (ahead, right, down) in axes.items():
        corners = [(-1, -1, -1, 1), (1, -1, 1, 1), (-1, -1, 1, -1), (-1, 1, 1, 1)]
        for side, (right_0, down_0, right_1, down_1) in enumerate(corners):
            ends[face, side] = tuple(
                tuple((ahead + across * right + below * down).tolist())
                for across, below in ((right_0, down_0), (right_1, down_1))
            )
    keys = list(ends)
    return [
        (*a, *b, int(ends[a] != ends[b]))
        for index, a in enumerate(keys)
        for b in keys[index + 1 :]
        if set(ends[a]) == set(ends[b])
    ]


def _edges(faces: Float[np.ndarray, "n s s 3"]) -> tuple[Float[np.ndarray, "4*n s 3"], Float[np.ndarray, "4*n"]]:
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
    return np.minimum(*(_differences_along(edges, other) for other in (edges, edges[:, ::-1])))


def _differences_along(
    edges: Float[np.ndarray, "n s 3"], others: Float[np.ndarray, "m s 3"]
) -> Float[np.ndarray, "n m"]:
    return np.stack([np.abs(edge - others).mean(axis=(1, 2)) for edge in edges])
