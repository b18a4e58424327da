"""Photographs of a turn: their angles by overlap, and what to state when they are read again with these angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import Around, Camera, Perspective
from lalaloc_core.photograph.levelling import MAX_ESTIMATED_SD
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.photograph import Assumed, Photograph, open_photograph
from lalaloc_core.photograph.stated_camera import HFOV_RANGE_DEG, MAX_PITCH_DEG, MAX_ROLL_DEG, StatedCamera
from lalaloc_core.photograph.turn_angles import TurnAngles, TurnView, angles_of_turn

# Largest relative standard deviation of the focal length by several photographs' lines: their errors are alike.
_LINES_FOCAL_SD = 0.03
# Least standard deviation (degrees) of relative headings that are stated.
_LEAST_STD_DEG = 0.5


@dataclass(frozen=True, kw_only=True)
class Turned:
    """Angles of a photograph of a turn, and how to read it again.

    Attributes:
        angles: the angles by overlap.
        hfov, pitch, roll: angles that the photograph is to be read with.
        stated: statements with these angles; None if the photograph is read so already.
    """

    angles: TurnAngles
    hfov: Assumed
    pitch: Assumed
    roll: Assumed
    stated: StatedCamera | None

    def applied(self, photograph: Photograph) -> Photograph:
        """Return the photograph, read again as `stated`, with the origins of its angles."""
        warnings = photograph.warnings
        if self.hfov.source == "estimated":
            hfov_deg, sd_deg = math.degrees(self.hfov.value), math.degrees(self.hfov.sd)
            warnings += (
                f"the field of view of {hfov_deg:.0f}° ± {2.0 * sd_deg:.0f}° was estimated from all photographs of the "
                "turn; send hfov_deg or the camera's original files",
            )
        return replace(photograph, hfov=self.hfov, pitch=self.pitch, roll=self.roll, warnings=warnings)


def open_turn(
    contents: Sequence[bytes], stated: StatedCamera, *, sphere_size: tuple[int, int], patch_size: PatchSize | None
) -> tuple[list[Photograph], list[TurnAngles]]:
    """Read photographs of one spot, in the order in which they were taken, with the angles that overlap tells.

    Raises:
        InvalidPhotographError: a photograph cannot be read, or is a sphere.
    """
    read = partial(open_photograph, sphere_size=sphere_size, patch_size=patch_size)
    photographs = [read(content, stated=stated, overview=True) for content in contents]
    if any(photograph.overview is None for photograph in photographs):
        raise InvalidPhotographError("a full sphere is among the photographs; localise it by itself")
    views = turn_views(photographs)
    angles = angles_of_turn(views)
    for index, turned in enumerate(turned_photographs(photographs, views, stated, angles)):
        if turned.stated is not None:
            photographs[index] = turned.applied(read(contents[index], stated=turned.stated))
    return photographs, angles


def stated_headings(angles: Sequence[TurnAngles]) -> tuple[list[float | None], float]:
    """Return what to state beside features of photographs: their relative headings and the deviation (degrees).

    Headings of photographs that do not overlap with the first are unknown.
    """
    std_deg = max(math.degrees(angle.heading_sd) for angle in angles if not angle.group)
    headings = [None if angle.group else round(math.degrees(angle.heading), 2) for angle in angles]
    return headings, round(max(std_deg, _LEAST_STD_DEG), 2)


def turn_views(photographs: Sequence[Photograph]) -> list[TurnView]:
    """Return what tells the angles of photographs of one spot, none of them a sphere; small, to be sent to a worker.

    An unknown field of view is that of the photographs that have one, else the mean of the estimates.
    """
    known = [view for view in photographs if _has_lens(view)]
    usual = known or [view for view in photographs if isinstance(view.camera, Perspective)]
    log_focal = float(np.mean([math.log(_long_focal(view)) for view in usual])) if usual else 0.0
    return [_turn_view(view, log_focal, is_known=bool(known)) for view in photographs]


def _turn_view(view: Photograph, log_focal: float, *, is_known: bool) -> TurnView:
    assert view.camera is not None
    assert view.overview is not None
    camera, focal_sd = view.camera, 0.0
    if not _has_lens(view) and isinstance(camera, Perspective):
        focal = math.exp(log_focal) * max(camera.width, camera.height)
        camera = replace(camera, fx=focal, fy=focal)
        focal_sd = 0.0 if is_known else _LINES_FOCAL_SD
    pitch, roll = (angle.value if angle.source == "given" else None for angle in (view.pitch, view.roll))
    return TurnView(overview=view.overview, camera=camera, focal_sd=focal_sd, pitch=pitch, roll=roll)


def turned_photographs(
    photographs: Sequence[Photograph], views: Sequence[TurnView], stated: StatedCamera, angles: Sequence[TurnAngles]
) -> list[Turned]:
    """Return how to read photographs again with the angles that their overlap tells."""
    return [_turned(*each, stated) for each in zip(photographs, views, angles, strict=True)]


def _turned(view: Photograph, turn_view: TurnView, angles: TurnAngles, stated: StatedCamera) -> Turned:
    attitude = angles.attitude
    pitch, roll = (
        Assumed(value=value, sd=sd, source="estimated" if sd < MAX_ESTIMATED_SD else "assumed")
        for value, sd in ((attitude.pitch, attitude.pitch_sd), (attitude.roll, attitude.roll_sd))
    )
    pitch = view.pitch if view.pitch.source == "given" else pitch
    roll = view.roll if view.roll.source == "given" else roll
    camera, hfov = turn_view.camera, view.hfov
    if not _has_lens(view) and isinstance(camera, Perspective):
        focal = camera.fx * angles.focal_factor
        camera = replace(camera, fx=focal, fy=focal)
        focal_sd = max(angles.focal_sd, _LINES_FOCAL_SD)
        hfov = Assumed(value=camera.hfov, sd=focal_sd * math.sin(camera.hfov), source="estimated")
    again = _again(view, camera, pitch.value, roll.value, stated)
    if again is None:
        hfov, pitch, roll = view.hfov, view.pitch, view.roll
    return Turned(angles=angles, hfov=hfov, pitch=pitch, roll=roll, stated=again)


def _again(view: Photograph, camera: Camera, pitch: float, roll: float, stated: StatedCamera) -> StatedCamera | None:
    """Return the statements that read a photograph with a camera and a tilt; None if it must be read as it was."""
    pitch_deg, roll_deg, hfov_deg = math.degrees(pitch), math.degrees(roll), math.degrees(camera.hfov)
    low, high = HFOV_RANGE_DEG[view.projection]
    is_possible = abs(pitch_deg) <= MAX_PITCH_DEG and abs(roll_deg) <= MAX_ROLL_DEG and low <= hfov_deg <= high
    if isinstance(camera, Around) or not is_possible:
        return None
    return StatedCamera(
        projection=view.projection,
        hfov_deg=hfov_deg if stated.intrinsics is None else None,
        intrinsics=stated.intrinsics,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
    )


def _has_lens(view: Photograph) -> bool:
    """Return whether the field of view was stated, or is in the photograph's metadata."""
    return view.hfov.source not in ("estimated", "assumed")


def _long_focal(view: Photograph) -> float:
    """Return the focal length as a share of the longer side."""
    assert isinstance(view.camera, Perspective)
    return view.camera.fx / max(view.camera.width, view.camera.height)
