"""Camera models: from rays to pixels and back.

Rays are in the camera's frame (right, forward, up). Pixel coordinates are continuous: x to the right and y down from
the picture's top left corner, so the centre of pixel (row i, column j) is (j + 0.5, i + 0.5). OpenCV counts from the
centre of that pixel instead, `HALF_PIXEL` from the corner; `stated_camera.py` converts.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

# Place of OpenCV's origin, the centre of the first pixel.
HALF_PIXEL = 0.5
# Newton steps that undo distortions; each doubles the number of correct digits.
_STEPS = 12
_TINY = 1e-12
# Angle from the optical axis within which a perspective camera sees.
_MAX_PERSPECTIVE = math.radians(85.0)

LensT = TypeVar("LensT", bound="_Lens")


@dataclass(frozen=True, kw_only=True)
class _Lens:
    """Camera with a lens.

    Attributes:
        width, height: size of the picture, pixels.
        fx, fy: focal lengths, pixels; of a fisheye, pixels per radian.
        cx, cy: optical centre, pixels from the top left corner.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    _limit: float = field(init=False, repr=False)

    @property
    def resolution(self) -> float:
        """Pixels per radian at the optical axis."""
        return self.fx

    def scaled(self: LensT, width: int, height: int) -> LensT:
        """Return the camera of the picture scaled to another size."""
        across, down = width / self.width, height / self.height
        size = {"width": width, "height": height}
        focal = {"fx": self.fx * across, "fy": self.fy * down}
        return dataclasses.replace(self, **size, **focal, cx=self.cx * across, cy=self.cy * down)


@dataclass(frozen=True, kw_only=True)
class Perspective(_Lens):
    """Pinhole camera with OpenCV's radial and tangential distortion."""

    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        k1, k2, k3 = self.radial
        turn = _first_root([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        object.__setattr__(self, "_limit", min(math.tan(_MAX_PERSPECTIVE), math.sqrt(turn)))

    @classmethod
    def of_hfov(cls, width: int, height: int, hfov: float) -> Perspective:
        """Return the camera without distortion that has a horizontal field of view (radians)."""
        focal = 0.5 * width / math.tan(0.5 * hfov)
        return cls(width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)

    @property
    def hfov(self) -> float:
        """Horizontal field of view, radians: between the ends of the row of the optical axis."""
        sides = self.rays(np.array([[0.0, self.cy], [float(self.width), self.cy]]))
        left, right = np.arctan2(sides[:, 0], sides[:, 1])
        return float(right - left)

    def pixels(self, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
        """Return the pixel coordinates (x, y) of rays of any length, and which of them the picture shows."""
        right, forward, up = rays[..., 0], rays[..., 1], rays[..., 2]
        # Rays from behind are not seen; any positive number avoids dividing by zero.
        depth = np.where(forward > _TINY, forward, 1.0)
        x, y = right / depth, -up / depth
        in_front = (forward > _TINY) & (x * x + y * y < self._limit**2)
        if self._distorted:
            x, y = self._distort(np.where(in_front, x, 0.0), np.where(in_front, y, 0.0))[:2]
        pixels = np.stack([x * self.fx + self.cx, y * self.fy + self.cy], axis=-1)
        return pixels, in_front & _inside(pixels, self.width, self.height)

    def rays(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Return the unit rays of pixel coordinates (x, y)."""
        wanted_x, wanted_y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        x, y = wanted_x, wanted_y
        for _ in range(_STEPS if self._distorted else 0):
            found_x, found_y, xx, xy, yy = self._distort(x, y)
            error_x, error_y = found_x - wanted_x, found_y - wanted_y
            determinant = xx * yy - xy * xy
            determinant = np.where(np.abs(determinant) > _TINY, determinant, _TINY)
            x = x - (yy * error_x - xy * error_y) / determinant
            y = y - (xx * error_y - xy * error_x) / determinant
        return _unit(x, np.ones_like(x), -y)

    @property
    def _distorted(self) -> bool:
        return any((*self.radial, *self.tangential))

    def _distort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the distorted coordinates, and their derivatives xx, xy = yx and yy."""
        (k1, k2, k3), (p1, p2) = self.radial, self.tangential
        square = x * x + y * y
        gain = 1.0 + square * (k1 + square * (k2 + square * k3))
        slope = 2.0 * (k1 + square * (2.0 * k2 + square * 3.0 * k3))
        return (
            x * gain + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * gain + 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y),
            gain + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            gain + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )


@dataclass(frozen=True, kw_only=True)
class Fisheye(_Lens):
    """OpenCV's fisheye camera: the angle θ from the axis lies at f θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸).

    Attributes:
        max_angle: largest angle from the axis that the lens shows, radians.
    """

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    max_angle: float = math.pi

    def __post_init__(self) -> None:
        k1, k2, k3, k4 = self.radial
        turn = _first_root([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        object.__setattr__(self, "_limit", min(self.max_angle, math.sqrt(turn)))

    @classmethod
    def of_hfov(cls, width: int, height: int, hfov: float) -> Fisheye:
        """Return the equidistant camera that has a horizontal field of view (radians).

        A square picture shows a circle, because no lens fills its corners beyond 180°.
        """
        focal = width / hfov
        circular = abs(width / height - 1.0) < 0.1
        angle, cx, cy = 0.5 * hfov if circular else math.pi, 0.5 * width, 0.5 * height
        return cls(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, max_angle=angle)

    @property
    def hfov(self) -> float:
        """Horizontal field of view, radians: between the ends of the row of the optical axis."""
        sides = np.array([[0.0, self.cy], [self.width, self.cy]])
        return float(np.minimum(self._angles(sides)[0], self._limit).sum())

    def pixels(self, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
        """Return the pixel coordinates (x, y) of rays of any length, and which of them the picture shows."""
        right, forward, up = rays[..., 0], rays[..., 1], rays[..., 2]
        across = np.hypot(right, up)
        angle = np.arctan2(across, forward)
        gain = self._radius(angle)[0] / np.maximum(across, _TINY)
        pixels = np.stack([right * gain * self.fx + self.cx, -up * gain * self.fy + self.cy], axis=-1)
        return pixels, (angle <= self._limit) & _inside(pixels, self.width, self.height)

    def rays(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Return the unit rays of pixel coordinates (x, y)."""
        angle, x, y = self._angles(pixels)
        share = np.sin(angle) / np.maximum(np.hypot(x, y), _TINY)
        return _unit(x * share, np.cos(angle), -y * share)

    def _angles(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return angles from the axis, and the normalised coordinates that they were computed from."""
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        wanted = np.hypot(x, y)
        angle = np.minimum(wanted, self._limit)
        for _ in range(_STEPS if any(self.radial) else 0):
            radius, slope = self._radius(angle)
            angle = np.clip(angle - (radius - wanted) / np.maximum(slope, 1e-3), 0.0, self._limit)
        return angle, x, y

    def _radius(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance from the centre, in focal lengths, and its derivative."""
        k1, k2, k3, k4 = self.radial
        square = angle * angle
        radius = angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        slope = 1.0 + square * (3.0 * k1 + square * (5.0 * k2 + square * (7.0 * k3 + square * 9.0 * k4)))
        return radius, slope


@dataclass(frozen=True, kw_only=True)
class Around:
    """Picture of a cylinder or a sphere around the camera, with square pixels at the horizon.

    Attributes:
        width, height: size of the picture, pixels.
        hfov: horizontal field of view, radians; at most 2π.
        elevation: that of the middle row, radians; the axis of the cylinder stays vertical.
        spherical: rows are elevations (equirectangular) instead of their tangents (cylindrical).
    """

    width: int
    height: int
    hfov: float
    elevation: float = 0.0
    spherical: bool = False

    @property
    def resolution(self) -> float:
        """Pixels per radian at the optical axis."""
        return self.width / self.hfov

    def pixels(self, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
        """Return the pixel coordinates (x, y) of rays of any length, and which of them the picture shows."""
        azimuth = np.arctan2(rays[..., 0], rays[..., 1])
        across = np.hypot(rays[..., 0], rays[..., 1])
        rise = np.arctan2(rays[..., 2], across) if self.spherical else rays[..., 2] / np.maximum(across, _TINY)
        pixels = np.stack(
            [0.5 * self.width + azimuth * self.resolution, self._horizon - rise * self.resolution], axis=-1
        )
        return pixels, _inside(pixels, self.width, self.height)

    def rays(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Return the unit rays of pixel coordinates (x, y)."""
        azimuth = (pixels[..., 0] - 0.5 * self.width) / self.resolution
        rise = (self._horizon - pixels[..., 1]) / self.resolution
        return _unit(np.sin(azimuth), np.cos(azimuth), np.tan(rise) if self.spherical else rise)

    def scaled(self, width: int, height: int) -> Around:
        """Return the camera of the picture scaled to another size."""
        return dataclasses.replace(self, width=width, height=height)

    @property
    def _horizon(self) -> float:
        """Row of the horizon, pixels from the top."""
        middle = self.elevation if self.spherical else math.tan(self.elevation)
        return 0.5 * self.height + middle * self.resolution


Camera = Perspective | Fisheye | Around


def _first_root(coefficients: list[float]) -> float:
    """Return the smallest positive root of a polynomial, infinity without one; highest power first."""
    roots = np.roots(coefficients)
    positive = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(positive.min()) if len(positive) else math.inf


def _inside(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    x, y = pixels[..., 0], pixels[..., 1]
    return (x >= 0.0) & (x <= width) & (y >= 0.0) & (y <= height)


def _unit(right: np.ndarray, forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    rays = np.stack([right, forward, up], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def camera_axes(*, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Return the camera's right, forward and up as rows, in a level frame with the same heading."""
    return level_axes(np.array([[0.0, pitch, roll]]))[0]


def level_axes(angles: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return right, forward and up (rows) of cameras in a level frame, by heading, pitch and roll (radians)."""
    cosine, sine, axes = np.cos(angles), np.sin(angles), np.empty((*angles.shape, 3))
    (turn, level, upright), (swing, rise, lean) = ([each[..., index] for index in range(3)] for each in (cosine, sine))
    above = -swing * rise, -turn * rise, level
    for column, (right, up) in enumerate(zip((turn, -swing, 0.0), above, strict=True)):
        axes[..., 0, column] = upright * right - lean * up
        axes[..., 2, column] = lean * right + upright * up
    axes[..., 1, 0], axes[..., 1, 1], axes[..., 1, 2] = level * swing, level * turn, rise
    return axes
