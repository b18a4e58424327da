"""Motion of the camera of a film, about, by optical flow from sample to sample."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Longer side (pixels) of the pictures that are compared, corners of one, their quality and distance (pixels).
_LONG_SIDE, _CORNERS, _QUALITY, _APART = 400, 200, 0.01, 6
# Least number of corners that must be found again, and the largest error (pixels) of those that move together.
_LEAST, _TOGETHER = 8, 3.0
# Field of view of the shorter side of phones' films, and the step of kept frames as a share of the field.
_USUAL_FIELD, _STEP_SHARE = math.radians(53.0), 0.25
# Blank pictures: gradient (grey levels per pixel of a Sobel kernel, blurred by so many pixels) that a smaller share of
# pixels reach. Codecs copy blank parts from sample to sample, as if the camera stood still.
_BLANK, _BLUR, _MARKED_SHARE = 4.0, 2.0, 0.01
# Upright edges: largest shift (share of the width), least correlation and gradient of the columns' means.
_SHIFT, _CORRELATION, _EDGE = 0.2, 0.85, 2.0
# Corners that contradict upright edges, by so much (radians, share): fewer than so many, or still ones, are wrong.
_UNLIKE, _UNLIKE_SHARE, _FEW, _STILL = math.radians(1.5), 0.4, 20, math.radians(0.5)
# Errors of the turn to a sample as a share: by corners, by upright edges, which near things mislead, and guessed.
_CORNER_SHARE, _EDGE_SHARE, _GUESSED_SHARE = 0.1, 0.3, 0.35
# Walking: change of size (natural logarithm) over the film, or of the share of corners that move together.
_GROWN, _APART_SHARE = math.log(1.6), 0.45
# Shaking: nod (radians) between samples.
_NOD = math.radians(2.0)
# Small grey picture of a sample, the mean gradient across each column, and whether it is blank.
_Look = tuple[np.ndarray, np.ndarray, bool]


class FlowTracker:
    """Angle that the camera of a film has turned through, about.

    Attributes:
        heading: angle (radians) since the first sample, clockwise, if the turn goes on where nothing can be followed.
        step: angle (radians) between frames that are kept.
        scale: factor that makes headings those of the true field of view; see `calibrate`.
    """

    def __init__(self, hfov: float | None = None) -> None:
        """Begin with the horizontal field of view (radians); None for that of phones."""
        self.heading, self.step = 0.0, _STEP_SHARE * (hfov or _USUAL_FIELD)
        self.scale = 1.0
        self._hfov = hfov
        self._before: _Look | None = None
        self._speed = 0.0
        self._turns: list[float] = []
        self._errors: list[float] = []
        self._least = self._most = 0.0
        self._nods: list[float] = []
        self._down = 0.0
        self._shares: list[float] = []
        self._grown = 0.0

    def follow(self, grey: UInt8[np.ndarray, "h w"]) -> float:
        """Return the heading (radians) of the next sample."""
        share = min(_LONG_SIDE / max(grey.shape), 1.0)
        look = _look(cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA))
        before, self._before = self._before, look
        if before is None:
            return self.heading
        turn, error = self._turn(before, look)
        self._turns.append(turn)
        self._errors.append(error)
        if not math.isnan(turn):
            self._speed = turn
        self.heading += self._speed
        self._least, self._most = min(self._least, self.heading), max(self._most, self.heading)
        return self.heading

    def _turn(self, before: _Look, after: _Look) -> tuple[float, float]:
        """Return the turn (radians) between samples with its error as a share; not a number if nothing tells it."""
        (first, first_upright, was_blank), (second, second_upright, is_blank) = before, after
        if was_blank or is_blank:
            return math.nan, _GUESSED_SHARE
        moved, focal = _moved(first, second), self._focal(*second.shape[::-1])
        shift = _edges_shift(first_upright, second_upright)
        swept = None if shift is None else math.atan(-shift / focal)
        if moved is None:
            return (math.nan, _GUESSED_SHARE) if swept is None else (swept, _EDGE_SHARE)
        places, growth, share = moved
        # Angles, because pixels near the border are narrower.
        angles = np.arctan(places / focal)
        across, down = np.median(angles[1] - angles[0], axis=0)
        turn = -float(across)
        self._down += float(down)
        if places.shape[1] < _FEW or abs(turn) < _STILL:
            if swept is None:
                return math.nan, _GUESSED_SHARE
            if abs(turn - swept) > max(_UNLIKE, _UNLIKE_SHARE * abs(swept)):
                return swept, _EDGE_SHARE
        self._nods.append(float(down))
        self._shares.append(share)
        self._grown += growth
        return turn, _CORNER_SHARE

    def reckoned(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Return headings of all samples (radians), and their errors summed up; where lost, the speed is the usual."""
        turns, errors = np.array(self._turns), np.array(self._errors)
        lost = np.isnan(turns)
        turns[lost] = 0.0 if lost.all() else np.median(turns[~lost])
        turns = self.scale * turns
        summed = np.cumsum([turns, errors * np.abs(turns)], axis=1)
        heading, error = np.concatenate([np.zeros((2, 1)), summed], axis=1)
        return heading, error

    def _focal(self, width: int, height: int) -> float:
        return _focal_of(self._hfov, width) if self._hfov else _focal_of(_USUAL_FIELD, min(width, height))

    def calibrate(self, hfov: float, size: tuple[int, int]) -> None:
        """Set the scale by the true horizontal field of view (radians) of pictures of a size (width, height)."""
        self.scale = self._focal(*size) / _focal_of(hfov, size[0])

    @property
    def number(self) -> int:
        """Number of the last sample."""
        return len(self._turns)

    @property
    def turned(self) -> float:
        """Angle (radians) between the outermost headings."""
        return self.scale * (self._most - self._least)

    @property
    def nod(self) -> float:
        """Root mean square (radians) of the change of nods from sample to sample."""
        return float(np.sqrt(np.mean(np.square(np.diff(self._nods))))) if len(self._nods) > 1 else 0.0

    @property
    def nodded(self) -> float:
        """Angle (radians) by which the camera nods from the first sample to the last."""
        return abs(self._down)

    @property
    def shakes(self) -> bool:
        """True if the camera nods as no hand does that turns it slowly."""
        return self.nod > _NOD

    @property
    def walks(self) -> bool:
        """True if things grow, or shift against each other, as they do not in a turn."""
        shifted = bool(self._shares) and float(np.median(self._shares)) < _APART_SHARE
        return abs(self._grown) > _GROWN or shifted

    @property
    def lost_share(self) -> float:
        """Share of the samples that could not be followed."""
        return float(np.isnan(self._turns).mean()) if self._turns else 0.0


def _look(grey: UInt8[np.ndarray, "h w"]) -> _Look:
    gradient = cv2.Sobel(cv2.GaussianBlur(grey, (0, 0), _BLUR), cv2.CV_32F, 1, 0)
    marked = np.count_nonzero(np.abs(gradient) >= _BLANK)
    return grey, gradient.mean(axis=0), bool(marked < _MARKED_SHARE * gradient.size)


def _focal_of(hfov: float, width: int) -> float:
    return 0.5 * width / math.tan(0.5 * min(hfov, 0.9 * math.pi))


def _edges_shift(one: Float[np.ndarray, "w"], other: Float[np.ndarray, "w"]) -> float | None:
    """Return the shift (pixels to the right) of upright edges by the columns' gradients; None if nothing tells it."""
    # Edges of plain walls have no corners, so the means of columns are compared.
    if np.abs(one).max() < _EDGE:
        return None
    width, most = len(one), round(_SHIFT * len(one))
    shift = np.arange(-most, most + 1)
    ahead, behind = np.maximum(shift, 0), np.maximum(-shift, 0)
    first, second = (np.concatenate([[0.0], np.cumsum(np.square(values, dtype=float))]) for values in (one, other))
    square = (first[width - ahead] - first[behind]) * (second[width - behind] - second[ahead])
    alike = np.correlate(other, one, "full")[width - 1 + shift] / np.maximum(np.sqrt(np.maximum(square, 0.0)), 1e-9)
    best = int(alike.argmax())
    return float(shift[best]) if alike[best] > _CORRELATION else None


def _moved(
    before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "2 n 2"], float, float] | None:
    """Return the motion of corners from one sample to the next; None if too few are found again.

    Of those that move together: their places (pixels from the centre) before and after, log growth, share of all.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _APART)
    if corners is None or len(corners) < _LEAST:
        return None
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    kept = status.ravel() == 1
    if int(kept.sum()) < _LEAST:
        return None
    centre = np.array([0.5 * before.shape[1], 0.5 * before.shape[0]], np.float32)
    one, other = corners[kept].reshape(-1, 2) - centre, found[kept].reshape(-1, 2) - centre
    change, together = cv2.estimateAffinePartial2D(one, other, method=cv2.RANSAC, ransacReprojThreshold=_TOGETHER)
    if change is None or int(together.sum()) < _LEAST:
        return None
    growth = math.hypot(change[0, 0], change[1, 0])
    agreed = together.ravel() == 1
    places = np.stack([one[agreed], other[agreed]]).astype(float)
    return places, math.log(max(growth, 1e-3)), float(agreed.mean())
