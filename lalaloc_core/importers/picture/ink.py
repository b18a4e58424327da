"""Separation of ink from paper: even lighting, straightening, and thresholding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.errors import InvalidFloorPlanError

# Finer pictures are reduced to this resolution (m per pixel), and larger ones to so many pixels, each of which takes
# half a microsecond: a flat of any size, or a storey of 35 m by 35 m, at the finest resolution.
FINEST_M, _MOST_PIXELS = 0.01, 12_000_000
# Warmth of grey pixels.
COLOURLESS = 128.0
# Lighting is evened out over this length.
_LIGHT_M = 1.2
# Floors are wider than walls (m), and paler (of 255). Least share of the picture that dark ones have.
_WIDER_M, _PALER, _LEAST_DARK = 0.6, 45.0, 0.01
_MAX_SKEW_DEG = 10.0
_SKEW_PIXELS = 700
# Shortest side of a part of a picture.
_MIN_SIDE_PX = 64
# Largest width of lines (m), and their smallest contrast: of 255, and as a multiple of the noise.
_LINE_M, _FAINTEST, _OVER_NOISE = 0.07, 40.0, 8.0
# Length of parts of a drawing and distance between them, as shares of its longest part; letters are shorter.
_LARGE_PARTS, _NEAR_PARTS = 0.1, 0.04
# Range of Otsu's threshold: pencil is ink, pale floors are not.
_THRESHOLD = (95.0, 205.0)
# Walls of one colour: longer side (pixels) of the picture in which they are looked for, their least share of what is
# drawn, tolerance (of 255), and least area relative to the square of half their width. Floors: least share of the
# picture, and of pixels with the tone of their neighbours.
_NETWORK_PX, _LEAST_COLOUR, _ALIKE, _SLENDER, _FLOORS, _FLAT, _SAME_TONE = 500, 0.04, 20.0, 200.0, 0.05, 0.6, 4

# Pictures: tones, colours, and pixels by whether they are of a kind or by the number of their part.
Gray, Colours = UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w 3"]
Mask, Labels = Bool[np.ndarray, "h w"], Int[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Ink:
    """Ink of a picture, straightened.

    Attributes:
        gray: grey picture with white paper; rows from the top.
        warmth: 128 without colour, higher towards red, lower towards blue; None for a grey picture.
        lines: `mask`, and faint lines that are darker than their surroundings.
        skew_deg: counter-clockwise rotation about the centre that straightened the picture.
        size: rows and columns of the picture before the rotation, at this resolution.
    """

    gray: Gray
    warmth: Gray | None
    mask: Mask
    lines: Mask
    metres_per_pixel: float
    skew_deg: float
    size: tuple[int, int]

    @property
    def _margin(self) -> Float[np.ndarray, "2"]:
        """Columns and rows that the rotation added on each side."""
        return 0.5 * np.subtract(self.mask.shape, self.size)[::-1]

    def to_plan(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert pixel coordinates (column, row; of edges, not centres) to metres with y up."""
        x, y = (np.asarray(points, dtype=float) - self._margin).T
        return np.column_stack([x, self.size[0] - y]) * self.metres_per_pixel

    def to_pixels(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert plan coordinates (m) to pixel coordinates (column, row); the inverse of `to_plan`."""
        x, y = (np.asarray(points_m, dtype=float) / self.metres_per_pixel).T
        return np.column_stack([x, self.size[0] - y]) + self._margin


def read_ink(gray: Gray, metres_per_pixel: float, warmth: Gray | None = None, *, straighten: bool = True) -> Ink:
    """Even out the lighting, straighten the picture unless told not to, and threshold it.

    Rows of `gray` are from the top, and 255 is white; for `warmth` see `Ink`.
    """
    factor = min(metres_per_pixel / FINEST_M, math.sqrt(_MOST_PIXELS / gray.size), 1.0)
    if factor < 1.0:
        rows, columns = (max(1, round(size * factor)) for size in gray.shape)
        gray = cv2.resize(gray, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8)
        if warmth is not None:
            warmth = cv2.resize(warmth, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8)
        metres_per_pixel /= factor
    even = _blank_floors(gray, _even_light(gray, metres_per_pixel), metres_per_pixel)
    threshold = _threshold(even)
    skew_deg = find_skew(even < threshold) if straighten else 0.0
    if skew_deg:
        even = rotate_picture(even, skew_deg)
        warmth = None if warmth is None else rotate_picture(warmth, skew_deg, fill=COLOURLESS)
    mask = even < threshold
    if warmth is not None and mask.any():
        # Lines of the colour of most ink, which can be brown or blue, have none.
        usual, colour = float(np.median(warmth[mask])) - COLOURLESS, warmth.astype(np.float32) - COLOURLESS
        colour -= np.clip(usual, np.minimum(colour, 0.0), np.maximum(colour, 0.0))
        warmth = (colour + COLOURLESS).astype(np.uint8)
    lines = mask | faint_lines(even, metres_per_pixel)
    return Ink(even, warmth, mask, lines, metres_per_pixel, skew_deg, gray.shape)


def blank_outside(picture: Gray, box: tuple[float, float, float, float]) -> Gray:
    """Return a picture that is paper outside a box: left, top, right and bottom in pixels. Coordinates stay."""
    rows, columns = picture.shape
    x0, y0, x1, y1 = (round(number) for number in box)
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, columns), min(y1, rows)
    if min(right - left, bottom - top) < _MIN_SIDE_PX:
        raise InvalidFloorPlanError(
            f"crop is {x0}, {y0}, {x1}, {y1}; a part of the picture of {columns} x {rows} pixels has at least "
            f"{_MIN_SIDE_PX} x {_MIN_SIDE_PX}, counted from its upper left corner"
        )
    part = picture[top:bottom, left:right]
    blank = np.full_like(picture, int(np.median(part)))
    blank[top:bottom, left:right] = part
    return blank


def darken_pale_walls(colours: Colours) -> Gray | None:
    """Return a grey picture with dark walls on white floors if walls are paler than floors, else None.

    Walls are the darkest of the long, thin areas of one colour in a drawing; floors are thick areas of one tone.
    """
    step = max(1, max(colours.shape) // _NETWORK_PX)
    small = np.ascontiguousarray(colours[::step, ::step])
    ground = np.median(small[[0, -1]].reshape(-1, 3), axis=0)
    codes = (small >> 4).astype(np.int32) @ np.array([256, 16, 1])
    codes[_of_tone(small, ground) > 0] = 4096
    counts = np.bincount(codes.ravel(), minlength=4097)[:4096]
    networks: list[tuple[float, Float[np.ndarray, "3"]]] = []
    for code in np.flatnonzero(counts > _LEAST_COLOUR * counts.sum()):
        tone = np.median(small[codes == code], axis=0)
        mask = _of_tone(small, tone)
        half = float(np.quantile(cv2.distanceTransform(mask, cv2.DIST_L2, 5)[mask > 0], 0.98))
        if mask.sum() >= _SLENDER * half**2:
            networks.append((half, tone))
    if not networks:
        return None
    half, tone = min(networks, key=lambda network: float(network[1].sum()))
    other = 1 - np.maximum(_of_tone(small, tone), _of_tone(small, ground))
    is_floor = cv2.erode(other, np.ones((2 * round(half) + 1,) * 2, np.uint8)) > 0
    steps = cv2.morphologyEx(small[..., 1], cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))[is_floor]
    is_flat = is_floor.mean() >= _FLOORS and (steps <= _SAME_TONE).mean() >= _FLAT
    if not is_flat or np.median(small[is_floor].mean(axis=1)) >= tone.mean():
        return None
    # Grown by a pixel, as their edges are blurred. Thin dark lines on floors stay, whatever the floor's tone.
    parts = cv2.erode(_of_tone(colours, tone), np.ones((2, 2), np.uint8), anchor=(1, 1))
    walls = cv2.dilate(parts, np.ones((4, 4), np.uint8), anchor=(1, 1))
    gray = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)
    paper = cv2.morphologyEx(gray, cv2.MORPH_CLOSE, np.ones((2 * round(half * step) + 1,) * 2, np.uint8))
    flat = np.where(_of_tone(colours, ground) > 0, 255, cv2.divide(gray, paper, scale=255.0))
    return np.where(walls > 0, 0, flat).astype(np.uint8)


def _of_tone(colours: Colours, tone: Float[np.ndarray, "3"]) -> Gray:
    """Return 1 where a picture has about a colour, else 0."""
    return np.asarray(cv2.inRange(colours, tone - _ALIKE, tone + _ALIKE), np.uint8) & np.uint8(1)


def drawn_extent(gray: Gray) -> float:
    """Return the longer side (pixels) of the largest drawing in a picture, without titles and small print beside it."""
    ink = gray < min(float(np.median(gray)) - _FAINTEST, _THRESHOLD[1])
    boxes = boxes_of_parts(ink)
    longest = int(boxes[:, 2:].max(initial=0))
    near = round(_NEAR_PARTS * longest)
    drawn = np.zeros_like(ink)
    for x, y, width, height in boxes[boxes[:, 2:].max(axis=1) >= _LARGE_PARTS * longest]:
        drawn[max(y - near, 0) : y + height + near, max(x - near, 0) : x + width + near] = True
    return float(max(boxes_of_parts(drawn)[:, 2:].max(initial=0) - 2 * near, longest) or max(gray.shape))


def boxes_of_parts(mask: Mask | Gray) -> Int[np.ndarray, "n 4"]:
    """Return the left column, top row, width and height of connected parts."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return stats[1:, :4]


def faint_lines(even: Gray, metres_per_pixel: float, faintest: float = _FAINTEST) -> Mask:
    """Return thin lines that are darker than their surroundings, at least by `faintest` and by the paper's noise."""
    soft = cv2.GaussianBlur(even, (0, 0), 0.6)
    noise = 1.48 * float(np.median(np.abs(soft.astype(np.int16) - cv2.medianBlur(soft, 5))))
    size = max(5, round(_LINE_M / metres_per_pixel) | 1)
    depth = cv2.morphologyEx(soft, cv2.MORPH_BLACKHAT, np.ones((size, size), np.uint8))
    return depth > max(faintest, _OVER_NOISE * noise)


def _even_light(gray: Gray, metres_per_pixel: float) -> Gray:
    """Divide the picture by the brightness of its paper, the smoothed local maximum."""
    size = max(3, round(_LIGHT_M / metres_per_pixel)) | 1
    coarse = 8
    small = cv2.resize(gray, None, fx=1.0 / coarse, fy=1.0 / coarse, interpolation=cv2.INTER_AREA)
    kernel = np.ones((max(3, size // coarse) | 1,) * 2, np.uint8)
    paper = cv2.GaussianBlur(cv2.dilate(small, kernel), (0, 0), max(1.0, 0.3 * size / coarse))
    paper = cv2.resize(paper, gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    even = 255.0 * gray.astype(np.float32) / np.maximum(paper.astype(np.float32), 60.0)
    return np.clip(even, 0, 255).astype(np.uint8)


def _blank_floors(gray: Gray, even: Gray, metres_per_pixel: float) -> Gray:
    """Return an even picture with white floors: areas of the grey picture wider than walls, and paler than most."""
    around = np.ones((round(_WIDER_M / metres_per_pixel) | 1,) * 2, np.uint8)
    paper, threshold = cv2.morphologyEx(gray, cv2.MORPH_CLOSE, around), _threshold(even)
    ink = gray[(even < threshold) & (paper >= threshold)]
    is_floor = paper > (float(np.median(ink)) if ink.size else 255.0) + _PALER
    if (is_floor & (paper < threshold)).mean() < _LEAST_DARK:
        return even
    return np.where(is_floor, cv2.divide(gray, paper, scale=255.0), even).astype(np.uint8)


def _threshold(even: Gray) -> float:
    threshold, _ = cv2.threshold(even, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return float(np.clip(threshold, *_THRESHOLD))


def find_skew(ink: Mask, reach_deg: float = _MAX_SKEW_DEG) -> float:
    """Return the rotation (degrees) that aligns most lines of a drawing with rows and columns, up to `reach_deg`.

    It maximises the energy of the differences between neighbouring row sums and column sums.
    """
    factor = min(1.0, _SKEW_PIXELS / max(ink.shape))
    small = cv2.resize(ink.astype(np.float32), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)

    def energy(degrees: float) -> float:
        rotated = rotate_picture(small, degrees, fill=0.0)
        return sum(float(np.sum(np.diff(rotated.sum(axis=axis)) ** 2)) for axis in (0, 1))

    best = 0.0
    for step, reach in ((1.0, reach_deg), (0.25, 1.0), (0.05, 0.25)):
        candidates = best + np.arange(-reach, reach + 0.5 * step, step)
        best = float(max(candidates, key=lambda degrees: energy(float(degrees))))
    # Skip small rotations, because resampling blurs a straight drawing.
    return best if abs(best) >= 0.15 and energy(best) > 1.02 * energy(0.0) else 0.0


def rotate_picture(picture: np.ndarray, degrees: float, fill: float = 255.0) -> np.ndarray:
    """Rotate the picture about its centre, on a canvas that holds all of it."""
    rows, columns = picture.shape
    angle = math.radians(abs(degrees))
    wide = math.ceil(columns * math.cos(angle) + rows * math.sin(angle))
    high = math.ceil(rows * math.cos(angle) + columns * math.sin(angle))
    matrix = cv2.getRotationMatrix2D((0.5 * columns - 0.5, 0.5 * rows - 0.5), degrees, 1.0)
    matrix[:, 2] += 0.5 * (wide - columns), 0.5 * (high - rows)
    return cv2.warpAffine(picture, matrix, (wide, high), flags=cv2.INTER_LINEAR, borderValue=fill)
