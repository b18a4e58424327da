"""Pictures that hold a sphere otherwise than as one equirectangular picture, told by their pixels.

Such a picture passes for an ordinary photograph by its size, and would be localised with a wrong geometry. A sphere on
its side or within bars is taken out of the picture; other formats are refused by name. All detectors judge one small
picture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.photograph.projection import COARSEST, is_sphere

# Longest side (pixels) of judged pictures.
THUMBNAIL_SIDE = 504
# Relative deviation of a ratio of sides; editors round.
_TOLERANCE = 0.01
# Eyes of a stereo picture: height and width (pixels) of compared pictures, the smallest correlation of two eyes (other
# pictures reach 0.57, a plain corridor seen both ways), and the largest shift between them (pixels).
_EYE, _MIN_CORRELATION, _MAX_SHIFT = (64, 128), 0.75, 6
# Bars: largest spread of grey levels along a row, share of a row that is of the bar, beside texts, and least share of
# the height; shares of the picture that bars around photographs have, and fewest rows between them. Share of
# the rows of a bar that have its colour.
_MAX_BAR_SPREAD, _OF_BAR, _MIN_BARS, _PHOTOGRAPH_BARS, _FEWEST_ROWS = 4.0, 0.8, 0.02, (0.08, 0.85), 48
_PLAIN_OF_BARS = 0.3
# Bars that are not alike: largest difference from their colour. All: share of a row beside their edge that is of them,
# and rows that mix both, in a photograph and in films, whose blocks have 16 pixels.
# Blurred ones: ratio of the step at their edge to those beside it, and of the detail within to theirs; largest step.
_EXACT_SPREAD, _WHOLE_ROW, _EDGE_ROWS, _EDGE_OF_BLUR, _MAX_STEP = 2.0, 0.98, (3, 10), 2.5, 40
# Bars within bars, as in windows. Gradients: samples of a row that tell its colour, largest difference from it, and
# from one row to the next but one.
_MOST_NESTED, _SAMPLES, _MAX_GRADED, _MAX_SLOPE = 3, 9, 4, 6
# Collages: pixels from one side of a border to the other, difference that is a change, share of a border that changes,
# and how much more that is than of other lines. Of 776 views of 67 rooms none has such lines in the middle both ways,
# and 99 % of 400 collages of them have.
_ACROSS, _CHANGE, _MIN_CHANGED, _MORE_CHANGED, _BORDER_SLACK = 3, 8, 0.8, 0.4, 0.03
# Circles: side (pixels) of judged squares, radii of the ring inside and of the corners, and grey levels of the corners.
_CIRCLE = 64
_RING, _CORNERS = (0.8, 0.93), 1.12
_DARK, _MIN_STEP, _MIN_DARK_SHARE = 40.0, 25.0, 0.97
_SECTORS = 8
# Cube maps: rows and columns of their faces, and side (pixels) of judged cells of crosses and faces of others.
_CROSSES, _GRIDS = ((3, 4), (4, 3)), ((2, 3), (3, 2), (1, 6), (6, 1))
_CELL, _FACE = 18, 42
# Empty cells of a cross: largest spread of grey levels, and difference between cells.
_MAX_SPREAD, _MAX_DIFFERENCE = 5.0, 10.0
# Edges of faces: ratio of the difference across a border to that between lines next to it, up to which they continue
# each other and from which they do not; least shares of continued edges and of broken borders.
_CONTINUED, _BROKEN = 2.5, 4.0
_MIN_CONTINUED, _MIN_BROKEN = 0.8, 0.25
# First row or column between bars, and the end.
_Side = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class SphereFormat:
    """Format of a picture that holds a sphere, or a photograph within bars.

    Attributes:
        box: part of the picture with the sphere or photograph, as shares (left, top, right, bottom); None if it is
            refused.
        is_sphere: it holds a sphere.
        is_stored: `box` is one of the stored picture, before its Exif orientation is applied.
    """

    text: str
    box: tuple[float, float, float, float] | None = None
    is_stored: bool = False
    is_sphere: bool = True


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Small upright picture, at most `THUMBNAIL_SIDE` wide and high, and the Exif orientation of the stored one."""

    pixels: UInt8[np.ndarray, "h w 3"]
    orientation: int = 1

    @cached_property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """Grey levels."""
        return cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY)

    @cached_property
    def looks_spherical(self) -> bool:
        """Result of `looks_spherical` for its pixels."""
        return looks_spherical(self.pixels)

    @cached_property
    def inside_bars(self) -> tuple[_Side, _Side]:
        """`inside_bars` of its pixels."""
        return inside_bars(self.pixels[None])


def find_sphere_format(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a picture; None for a photograph, or a sphere as it should be."""
    return next((found for find in _DETECTORS if (found := find(thumbnail)) is not None), None)


def looks_spherical(pixels: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether a picture of any size looks like a full sphere; see `is_sphere`."""
    return is_sphere(cv2.resize(pixels, COARSEST[::-1], interpolation=cv2.INTER_AREA))


def _has_ratio(pixels: np.ndarray, ratio: float) -> bool:
    height, width = pixels.shape[:2]
    # The judged size is rounded to whole pixels.
    return abs(width - ratio * height) <= max(_TOLERANCE * width, 1.0 + ratio)


def _halves(picture: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the halves of a picture, above one another (axis 0) or beside each other."""
    half = picture.shape[axis] // 2
    return (picture[:half], picture[-half:]) if axis == 0 else (picture[:, :half], picture[:, -half:])


def _find_sideways(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a sphere that the Exif orientation would turn on its side."""
    if thumbnail.orientation not in (5, 6, 7, 8) or not _has_ratio(thumbnail.pixels, 0.5):
        return None
    turns = 1 if thumbnail.orientation in (5, 6) else -1
    if not looks_spherical(np.ascontiguousarray(np.rot90(thumbnail.pixels, turns))):
        return None
    return SphereFormat(
        text=f"the photograph is a sphere with the Exif orientation {thumbnail.orientation}, which is ignored: its "
        "stored picture is twice as wide as high, and its borders continue each other",
        box=(0.0, 0.0, 1.0, 1.0),
        is_stored=True,
    )


def _find_circles(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a picture with one or two circles of fisheye lenses on black."""
    grey = thumbnail.grey
    height, width = grey.shape
    for ratio, axis in ((2.0, 1), (0.5, 0)):
        if _has_ratio(grey, ratio) and all(map(_is_circle, _halves(grey, axis))):
            return SphereFormat(
                text="the photograph is the dual fisheye picture of a 360° camera, two circles that are not stitched: "
                "export it from the camera's app as an equirectangular 360° photograph"
            )
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    beside = (part for part in (grey[:top], grey[:, :left]) if part.size)
    if all((part < _DARK).mean() > 0.9 for part in beside) and _is_circle(grey[top : top + side, left:][:, :side]):
        return SphereFormat(
            text="the photograph is the circle of a fisheye lens: state projection=fisheye and hfov_deg, its "
            "horizontal field of view (often 180), of the square around the circle"
        )
    return None


def _is_circle(square: UInt8[np.ndarray, "h w"]) -> bool:
    """Return whether a square picture is dark in its corners, and bright within its largest circle all around."""
    grey = cv2.resize(square, (_CIRCLE, _CIRCLE), interpolation=cv2.INTER_AREA)
    is_corner, ring = _circle_parts()
    corners = grey[is_corner].astype(float)
    if np.mean(corners < _DARK) < _MIN_DARK_SHARE or corners.std() > 0.3 * _DARK:
        return False
    bright = [np.median(grey[ring == sector]) > corners.mean() + _MIN_STEP for sector in range(_SECTORS)]
    return bool(sum(bright) >= _SECTORS - 1)


@cache
def _circle_parts() -> tuple[Bool[np.ndarray, "s s"], Int[np.ndarray, "s s"]]:
    """Return the corners of a square, and the sector of each pixel of the ring within it, -1 beside the ring."""
    place = (np.arange(_CIRCLE) + 0.5) / _CIRCLE * 2.0 - 1.0
    x, y = np.meshgrid(place, place)
    radius, sector = np.hypot(x, y), ((np.arctan2(y, x) / math.tau + 0.5) * _SECTORS).astype(int) % _SECTORS
    return radius > _CORNERS, np.where((radius > _RING[0]) & (radius < _RING[1]), sector, -1)


def _find_stereo(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a picture of two eyes, each with a sphere or 180° of it; 4:3 and 3:2 are of none."""
    pixels = thumbnail.pixels
    if any(_has_ratio(pixels, ratio) for ratio in (4.0 / 3.0, 0.75, 1.5, 2.0 / 3.0)):
        return None
    # Made small once for both ways, as that takes longest.
    small = cv2.resize(thumbnail.grey, (2 * _EYE[1], 2 * _EYE[0]), interpolation=cv2.INTER_AREA)
    for axis, name in enumerate(("above", "beside")):
        are_eyes = _look_alike(*_halves(small, axis))
        if are_eyes and all(map(looks_spherical, _halves(pixels, axis))):
            return SphereFormat(
                text=f"the photograph is a stereo sphere, one eye {name} the other: cut out one of them, and send it "
                "as a picture twice as wide as high"
            )
        if are_eyes and name == "beside" and _has_ratio(pixels, 2.0):
            return SphereFormat(
                text="the photograph is VR180, two eyes with 180° beside each other: cut out one of them, and send it "
                "with projection=equirectangular and hfov_deg=180"
            )
    return None


def _look_alike(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> bool:
    """Return whether two grey pictures show the same, up to the shift between two eyes."""
    height, width = _EYE
    # Slow changes and rows, as of light from above, are alike in all pictures.
    margin = width // 16
    details = []
    for half in (first, second):
        small = cv2.resize(half, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        inner = (small - cv2.GaussianBlur(small, (0, 0), margin / 2))[:, margin:-margin]
        details.append(inner - inner.mean(axis=1, keepdims=True))
    if min(inner.std() for inner in details) < 1.0:
        return False
    core = np.ascontiguousarray(details[0][:, _MAX_SHIFT:-_MAX_SHIFT])
    return float(cv2.matchTemplate(details[1], core, cv2.TM_CCOEFF_NORMED).max()) > _MIN_CORRELATION


def _find_bars(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a sphere within bars of one colour."""
    pixels = thumbnail.pixels
    height, width = pixels.shape[:2]
    if thumbnail.inside_bars == ((0, height), (0, width)):
        return None
    # Within them, a zenith of one colour is of the sphere.
    (top, bottom), (left, right) = inside_bars(pixels[None], is_exact=True)
    if (bottom - top) * (right - left) > (1.0 - _MIN_BARS) * height * width or min(bottom - top, right - left) < 16:
        return None
    # The bars are equal and the sphere twice as wide as high, which is more exact than the judged pixels.
    across, down = (right - left) / width, (bottom - top) / height
    exact = (1.0, width / 2.0 / height) if across > 0.98 else (2.0 * height / width, 1.0)
    slack = 2.5 / min(height, width)
    off = exact[0] - across, exact[1] - down, (left + right) / width - 1.0, (top + bottom) / height - 1.0
    if max(map(abs, off)) > slack or max(exact) > 1.0 + slack or not looks_spherical(pixels[top:bottom, left:right]):
        return None
    beside, above = 0.5 * (1.0 - min(exact[0], 1.0)), 0.5 * (1.0 - min(exact[1], 1.0))
    share = 1.0 - (1.0 - 2.0 * beside) * (1.0 - 2.0 * above)
    return SphereFormat(
        text=f"the photograph is a sphere with bars at its borders, {share:.0%} of the picture: they were cut off",
        box=(beside, above, 1.0 - beside, 1.0 - above),
    )


def _find_photograph_in_bars(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a photograph within bars of one colour, such as a screenshot, which can have texts there."""
    height, width = thumbnail.pixels.shape[:2]
    (top, bottom), (left, right) = thumbnail.inside_bars
    share = 1.0 - (bottom - top) * (right - left) / (height * width)
    if not _PHOTOGRAPH_BARS[0] <= share <= _PHOTOGRAPH_BARS[1] or min(bottom - top, right - left) < _FEWEST_ROWS:
        return None
    # Some cameras paint the zenith and nadir of their spheres in one colour.
    if _has_ratio(thumbnail.pixels, 2.0) and thumbnail.looks_spherical:
        return None
    return SphereFormat(
        text=f"the photograph is within bars, {share:.0%} of the picture, as in a screenshot: they were cut off; send "
        "the camera's original file",
        box=(left / width, top / height, right / width, bottom / height),
        is_sphere=False,
    )


def inside_bars(pictures: UInt8[np.ndarray, "f n m 3"], *, is_exact: bool = False) -> tuple[_Side, _Side]:
    """Return the first and the end of the rows, and of the columns, between bars in one or several pictures.

    Bars within them and rows that are mixed with them count as bars, unless `is_exact`.
    """
    top = left = 0
    for level in range(1 if is_exact else _MOST_NESTED):
        size, is_within = pictures.shape[1:3], level > 0
        begin, end = _between_bars(pictures, is_within=is_within, is_exact=is_exact)
        # OpenCV reads arrays that numpy transposed very slowly.
        turned = np.stack([cv2.transpose(picture) for picture in pictures[:, begin:end]])
        first, last = _between_bars(turned, is_within=is_within, is_exact=is_exact)
        top, left, pictures = top + begin, left + first, pictures[:, begin:end, first:last]
        if pictures.shape[1:3] == size or min(pictures.shape[1:3]) < _FEWEST_ROWS:
            break
    return (top, top + pictures.shape[1]), (left, left + pictures.shape[2])


def _between_bars(pictures: UInt8[np.ndarray, "f n m 3"], *, is_within: bool, is_exact: bool) -> tuple[int, int]:
    """Return the first row and the end of the rows between bars at the top and bottom; `is_within` others.

    Bars have one colour, beside texts, buttons and strips of small pictures, or are a gradient or a blurred copy of the
    picture.
    """
    ends, rows = (pictures, pictures[:, ::-1]), pictures.shape[1]
    (top, colour), (bottom, other) = (_plain_rows(end, 2.0 * _MAX_BAR_SPREAD) for end in ends)
    is_alike = top and bottom and np.abs(colour - other).max() <= 2.0 * _MAX_BAR_SPREAD
    if not is_alike and not (is_within and (top or bottom)):
        greys = np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures])
        top, bottom = _graded_rows(greys)
        if not top:
            top, bottom = (_plain_rows(end, _EXACT_SPREAD)[0] for end in ends)
        if not top and not bottom:
            top = bottom = _blurred_rows(greys)
    begin, end = top + (top > 0 and not is_exact), rows - bottom - (bottom > 0 and not is_exact)
    return (begin, end) if begin < end else (0, rows)


def _graded_rows(greys: UInt8[np.ndarray, "f n m"]) -> tuple[int, int]:
    """Return the number of rows of a gradient above and below the picture, up to edges along most of a row.

    Each of the rows has one colour, or they are all the same.
    """
    first, last, rows = greys[:, :1], greys[:, -1:], greys.shape[1]
    is_same = bool((cv2.absdiff(first, last) <= _MAX_GRADED).mean() > _WHOLE_ROW)
    if not is_same and max(np.ptp(first), np.ptp(last)) > _MAX_GRADED:
        return 0, 0
    changes = [cv2.threshold(cv2.absdiff(grey[2:], grey[:-2]), _MAX_SLOPE, 255, cv2.THRESH_BINARY)[1] for grey in greys]
    shares = np.min([cv2.reduce(change, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0] for change in changes], axis=0)
    edges = np.flatnonzero(shares > 0.5 * 255.0)
    if len(edges) < 2:
        return 0, 0
    top, bottom = int(edges[0]) + 2, rows - 1 - int(edges[-1])
    beside = np.concatenate([greys[:, :top], greys[:, rows - bottom :]], axis=1)
    usual = first if is_same else np.median(beside[:, :, :: max(1, greys.shape[2] // _SAMPLES)], axis=2, keepdims=True)
    is_bar = (np.abs(beside - usual.astype(np.float32)) <= _MAX_GRADED).mean(axis=2).min(axis=0) > _OF_BAR
    return (top, bottom) if min(is_bar[:top].mean(), is_bar[top:].mean()) > _OF_BAR else (0, 0)


def _plain_rows(pictures: UInt8[np.ndarray, "f n m 3"], spread: float) -> tuple[int, Float[np.ndarray, "3 1"]]:
    """Return the number of rows above the picture that have the colour of the first, up to a straight edge, and it."""
    colour, found = cv2.meanStdDev(np.ascontiguousarray(pictures[:, :1]).reshape(-1, 1, 3))
    if found.max() > 0.5 * spread:
        return 0, colour
    lowest, highest = np.floor(colour - spread) + 1.0, np.ceil(colour + spread) - 1.0
    masks = [cv2.inRange(np.ascontiguousarray(picture), lowest, highest) for picture in pictures]
    shares = np.min([cv2.reduce(mask, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0] for mask in masks], axis=0) / 255.0
    # The picture is the longest part without a row of that colour: texts and strips of small pictures are shorter.
    parts = np.flatnonzero(np.diff(shares <= _WHOLE_ROW, prepend=False, append=False)).reshape(-1, 2)
    begin = int(parts[np.argmax(np.ptp(parts, axis=1)), 0]) if len(parts) else 0
    edge = np.flatnonzero(shares[begin:][: _EDGE_ROWS[len(pictures) > 1]] < 0.5)
    rows = begin + int(edge[0]) if len(edge) else 0
    is_sharp = 2 < begin < rows + 1 < len(shares) - 1 and shares[begin - 2] > _WHOLE_ROW
    return rows if is_sharp and (shares[:rows] > _OF_BAR).mean() > _PLAIN_OF_BARS else 0, colour


def _blurred_rows(greys: UInt8[np.ndarray, "f n m"]) -> int:
    """Return the number of rows of each of two equal bars, which are smooth and end at straight edges; 0 without."""
    # Few edges are not to outweigh many small steps.
    changes = [cv2.threshold(cv2.absdiff(grey[1:], grey[:-1]), _MAX_STEP, 0, cv2.THRESH_TRUNC)[1] for grey in greys]
    steps = np.mean([cv2.reduce(change, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0] for change in changes], axis=0)
    wide = np.max([steps[:-2], steps[1:-1], steps[2:]], axis=0)
    edges = np.minimum(wide, wide[::-1])[: len(wide) // 2]
    rows = int(np.argmax(edges)) + 2
    if not _MIN_BARS * len(steps) < rows - 3 < 0.5 * len(steps) - 6:
        return 0
    is_edged = np.maximum(steps, steps[::-1])[: rows - 3].max() * _EDGE_OF_BLUR < edges.max()
    details = [np.abs(np.diff(grey.astype(np.float32), 2, axis=1)).mean(axis=1) for grey in greys] if is_edged else []
    beside = [(detail + detail[::-1])[: rows - 2].mean() / 2.0 for detail in details]
    inside = [detail[rows:-rows].mean() for detail in details]
    return rows if is_edged and np.mean(beside) * _EDGE_OF_BLUR < np.mean(inside) else 0


def _find_collage(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a grid of photographs: along the borders of its cells nearly all of the picture changes."""
    rows, columns = thumbnail.inside_bars
    inside = np.ascontiguousarray(thumbnail.pixels[slice(*rows), slice(*columns)])
    if min(inside.shape[:2]) < _FEWEST_ROWS:
        return None
    down = _cells(inside)
    across = _cells(cv2.transpose(inside)) if down > 1 else 1
    text = f"the photograph is a collage of {across} x {down} photographs: send each of them as a file of its own"
    return SphereFormat(text=text, is_sphere=False) if across > 1 else None


def _cells(picture: UInt8[np.ndarray, "n m 3"]) -> int:
    """Return the number of equal cells above one another."""
    half = cv2.resize(picture, None, fx=0.5, fy=1.0, interpolation=cv2.INTER_NEAREST)
    same = cv2.inRange(cv2.absdiff(half[_ACROSS:], half[:-_ACROSS]), (0, 0, 0), (_CHANGE,) * 3)
    changed = 1.0 - cv2.reduce(same, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0] / 255.0
    least, slack = max(_MIN_CHANGED, float(np.median(changed)) + _MORE_CHANGED), _BORDER_SLACK * len(changed)
    for cells in (2, 3):
        borders = [len(changed) * border / cells for border in range(1, cells)]
        if all(changed[int(border - slack) : int(border + slack) + 1].max() >= least for border in borders):
            return cells
    return 1


def _find_cube(thumbnail: Thumbnail) -> SphereFormat | None:
    """Return the format of a cube map."""
    height, width = thumbnail.pixels.shape[:2]
    for rows, columns in (*_CROSSES, *_GRIDS):
        if abs(width * rows - height * columns) > max(_TOLERANCE * width * rows, float(rows + columns)):
            continue
        is_cross = (rows, columns) in _CROSSES
        side = _CELL if is_cross else _FACE
        even = cv2.resize(thumbnail.pixels, (columns * side, rows * side), interpolation=cv2.INTER_AREA)
        cells = even.astype(np.float32).reshape(rows, side, columns, side, 3).transpose(0, 2, 1, 3, 4)
        if (_is_cross if is_cross else _is_cube)(cells):
            kind = "a cross of " if is_cross else ""
            return SphereFormat(
                text=f"the photograph is a cube map, {kind}{columns} x {rows} faces: convert it to equirectangular, "
                "twice as wide as high"
            )
    return None


def _is_cross(cells: Float[np.ndarray, "r c s s 3"]) -> bool:
    """Return whether cells are a cross: a band of four faces, one above and one below it, and empty cells."""
    rows, columns = cells.shape[:2]
    values = cells.reshape(rows, columns, -1, 3)
    is_empty = values.std(axis=2).max(axis=-1) < _MAX_SPREAD
    empty = values.mean(axis=2)[is_empty]
    if len(empty) != 6 or np.ptp(empty, axis=0).max() > _MAX_DIFFERENCE:
        return False
    if rows == 3:
        return not is_empty[1].any() and bool((is_empty[0] == is_empty[2]).all())
    return not (is_empty[:, 1].any() or is_empty[1].any())


def _is_cube(cells: Float[np.ndarray, "r c s s 3"]) -> bool:
    """Return whether the edges of six faces continue each other, and not only those of neighbours in the picture."""
    rows, columns = cells.shape[:2]
    faces = cells.reshape(6, _FACE, _FACE, 3)
    # Left, right, top and bottom edge of each face, and the line beside it.
    edges, beside = (
        np.stack([faces[:, :, a], faces[:, :, b], faces[:, a], faces[:, b]], axis=1).reshape(24, _FACE, 3)
        for a, b in ((0, -1), (1, -2))
    )
    steps = np.abs(edges - beside).mean(axis=(1, 2))

    def ratio(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the difference of edges, in the direction that fits better, relative to that of lines next to them."""
        ways = (np.abs(edges[first] - other[second]).mean(axis=(-2, -1)) for other in (edges, edges[:, ::-1]))
        return np.minimum(*ways) / (np.minimum(steps[first], steps[second]) + 1.0)

    index = 4 * np.arange(6).reshape(rows, columns)
    before = np.concatenate([index[:, :-1].ravel() + 1, index[:-1].ravel() + 3])
    after = np.concatenate([index[:, 1:].ravel(), index[1:].ravel() + 2])
    if np.mean(ratio(before, after) > _BROKEN) < _MIN_BROKEN:
        return False
    every = np.arange(24)
    ratios = ratio(every[:, None], every[None])
    ratios[every[:, None] // 4 == every // 4] = np.inf
    return bool(np.mean(ratios.min(axis=1) < _CONTINUED) >= _MIN_CONTINUED)


_DETECTORS: tuple[Callable[[Thumbnail], SphereFormat | None], ...] = (
    _find_sideways,
    _find_circles,
    _find_stereo,
    _find_bars,
    _find_cube,
    _find_collage,
    _find_photograph_in_bars,
)
