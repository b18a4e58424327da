"""Turns of a phone in generated homes: photographs, or frames of a film, of a camera that is turned by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import UInt8

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.data.synthetic.generated import RendererCache
from lalaloc_core.learn.data.synthetic.hand_held import Instant, exposed
from lalaloc_core.learn.data.views import cut_view, tilt_by_hand
from lalaloc_core.learn.synth.rendering.sphere_renderer import Window
from lalaloc_core.learn.synth.scene.shots import POSE_MARGIN_M, Shot
from lalaloc_core.photograph.cameras import Perspective

# Parts of the sphere that are rendered for a picture, with room for tilts, and their sizes: a finer one, and one for
# cameras of at most so many pixels a radian.
_WINDOW, _WINDOW_SIZE = Window(math.radians(100.0), math.radians(56.0)), (1008, 900)
_COARSE_WINDOW, _COARSE_WINDOW_SIZE, _COARSE = Window(math.radians(75.0), math.radians(50.0)), (650, 488), 370.0


@dataclass(frozen=True, kw_only=True)
class Phone:
    """Camera that is turned about a person who holds it.

    Attributes:
        width, height: size of its pictures, pixels.
        hfov_deg: horizontal field of view.
        arm_m: distance (m) from the axis of the turn to the camera.
    """

    width: int = 480
    height: int = 640
    hfov_deg: float = 53.0
    arm_m: float = 0.4

    @property
    def camera(self) -> Perspective:
        """The camera model."""
        return Perspective.of_hfov(self.width, self.height, math.radians(self.hfov_deg))


class Frame(NamedTuple):
    """Picture of a turn with its true heading, pitch and roll (radians)."""

    pixels: UInt8[np.ndarray, "h w 3"]
    heading: float
    pitch: float
    roll: float


def photographs_of_turn(
    shot: Shot, renderers: RendererCache, phone: Phone, count: int, rng: np.random.Generator
) -> list[Frame]:
    """Return photographs taken at about equal angles once around, each tilted as a hand tilts it."""
    headings = shot.heading + TWO_PI * np.arange(count) / count + np.radians(rng.normal(0.0, 2.0, count))
    headings[0] = shot.heading
    tilts = [tilt_by_hand(rng) for _ in range(count)]
    return list(_frames(shot, renderers, phone, list(zip(headings.tolist(), *zip(*tilts, strict=True), strict=True))))


def arm_within(shot: Shot, arm_m: float) -> float:
    """Return the length of an arm, shortened so that the camera stays in its room."""
    walls_m = shot.home.plan.rooms[shot.room_index].shape.exterior.distance(shapely.Point(shot.position_m))
    return min(arm_m, max(walls_m - POSE_MARGIN_M, 0.0))


def _frames(
    shot: Shot, renderers: RendererCache, phone: Phone, poses: Sequence[tuple[float, float, float]]
) -> Iterator[Frame]:
    """Yield the picture of each pose: heading, pitch and roll."""
    for heading, pitch, roll in poses:
        sphere = _seen_from(shot, renderers, phone, heading)
        yield Frame(cut_view(sphere, phone.camera, azimuth=0.0, pitch=pitch, roll=roll), heading, pitch, roll)


def film_of_turn(
    shot: Shot, renderers: RendererCache, phone: Phone, instants: Sequence[Instant]
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the frames of a film that a phone at arm's length takes; the first looks along the shot's heading."""
    for instant in instants:
        sphere = _seen_from(shot, renderers, phone, shot.heading + instant.turn)
        yield exposed(sphere, phone.camera, instant, azimuth=0.0)


def _seen_from(shot: Shot, renderers: RendererCache, phone: Phone, heading: float) -> UInt8[np.ndarray, "h w 3"]:
    """Render a part of the sphere at the end of the arm; the rest is grey."""
    is_coarse = phone.camera.fx <= _COARSE
    window, size = (_COARSE_WINDOW, _COARSE_WINDOW_SIZE) if is_coarse else (_WINDOW, _WINDOW_SIZE)
    place = shot.position_m + arm_within(shot, phone.arm_m) * np.array([math.sin(heading), math.cos(heading)])
    turned = dataclasses.replace(shot, position_m=place, heading=heading % TWO_PI)
    seen = renderers.renderer(*size, (1, 1), window).render([turned])[0].cpu().numpy()
    rows, columns = size
    # The sphere around the part that is rendered, at its resolution.
    width = round(columns * TWO_PI / window.width)
    sphere = np.full((width // 2, width, 3), 127, np.uint8)
    top, left = round((0.5 - window.top / math.pi) * (width // 2)), (width - columns) // 2
    sphere[top : top + rows, left : left + columns] = seen
    return sphere
