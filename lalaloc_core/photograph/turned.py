"""Photographs of a turn: their angles by overlap, and their patches by these angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import Camera, Perspective, camera_axes
from lalaloc_core.photograph.levelling import MAX_ESTIMATED_SD
from lalaloc_core.photograph.patches import PatchSize, cut_patches, seen_azimuths
from lalaloc_core.photograph.photograph import Assumed, Photograph, field_warning, open_photograph
from lalaloc_core.photograph.stated_camera import HFOV_RANGE_DEG, MAX_PITCH_DEG, MAX_ROLL_DEG, StatedCamera
from lalaloc_core.photograph.turn_angles import TurnAngles, TurnView, angles_of_turn

# Largest relative standard deviation of the focal length by several photographs' lines: their errors are alike.
_LINES_FOCAL_SD = 0.03
# Least standard deviation (degrees) of relative headings that are stated.
_LEAST_STD_DEG = 0.5


def open_turn(
    contents: Sequence[bytes], stated: StatedCamera, *, sphere_size: tuple[int, int], patch_size: PatchSize | None
) -> tuple[list[Photograph], list[TurnAngles]]:
    """Read photographs of one spot, in the order in which they were taken, with the angles that overlap tells."""
    sizes: dict[str, Any] = {"sphere_size": sphere_size, "patch_size": patch_size}
    photographs = [open_of_turn(content, stated, **sizes) for content in contents]
    return level_turn(photographs, patch_size or PatchSize())


def open_of_turn(
    content: bytes, stated: StatedCamera, *, sphere_size: tuple[int, int], patch_size: PatchSize | None
) -> Photograph:
    """Read one photograph of a turn, before `level_turn`."""
    photograph = open_photograph(content, sphere_size=sphere_size, stated=stated, patch_size=patch_size, purpose="turn")
    if photograph.overview is None:
        raise InvalidPhotographError("the photograph is a full sphere; localise it by itself, not in a turn")
    return photograph


def level_turn(photographs: Sequence[Photograph], size: PatchSize) -> tuple[list[Photograph], list[TurnAngles]]:
    """Return photographs of one spot, read with an overview for turns, with the angles that their overlap tells."""
    views = turn_views(photographs)
    angles = angles_of_turn(views)
    return turned_photographs(photographs, views, angles, size), angles


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
    known, guessed = (
        [each.camera for each in photographs if isinstance(each.camera, Perspective) and each.has_stated_field is given]
        for given in (True, False)
    )
    # Focal lengths as a share of the longer side.
    logs = [math.log(camera.fx / max(camera.width, camera.height)) for camera in known or guessed]
    log_focal = float(np.mean(logs)) if logs else 0.0
    return [_turn_view(photograph, log_focal, is_known=bool(known)) for photograph in photographs]


def _turn_view(photograph: Photograph, log_focal: float, *, is_known: bool) -> TurnView:
    assert photograph.camera is not None
    assert photograph.overview is not None
    camera, focal_sd, overview = photograph.camera, 0.0, photograph.overview
    if not photograph.has_stated_field and isinstance(camera, Perspective):
        focal = math.exp(log_focal) * max(camera.width, camera.height)
        camera, overview = replace(camera, fx=focal, fy=focal), replace(overview, attitude=None)
        focal_sd = 0.0 if is_known else _LINES_FOCAL_SD
    pitch, roll = (angle.value if angle.source == "given" else None for angle in (photograph.pitch, photograph.roll))
    return TurnView(overview=overview, camera=camera, focal_sd=focal_sd, pitch=pitch, roll=roll)


def turned_photographs(
    photographs: Sequence[Photograph], views: Sequence[TurnView], angles: Sequence[TurnAngles], size: PatchSize
) -> list[Photograph]:
    """Return photographs, with their patches, with the tilt and field of view that their overlap tells."""
    return [_turned(*each, size) for each in zip(photographs, views, angles, strict=True)]


def _turned(photograph: Photograph, turn_view: TurnView, angles: TurnAngles, size: PatchSize) -> Photograph:
    assert photograph.overview is not None
    if photograph.overview.picture is None:
        return replace(photograph, overview=None)
    attitude, camera, hfov, warnings = angles.attitude, turn_view.camera, photograph.hfov, photograph.warnings
    pitch, roll = (
        Assumed(value=value, sd=sd, source="estimated" if sd < MAX_ESTIMATED_SD else "assumed")
        for value, sd in ((attitude.pitch, attitude.pitch_sd), (attitude.roll, attitude.roll_sd))
    )
    pitch = photograph.pitch if photograph.pitch.source == "given" else pitch
    roll = photograph.roll if photograph.roll.source == "given" else roll
    if not photograph.has_stated_field and isinstance(camera, Perspective):
        focal = camera.fx * angles.focal_factor
        camera = replace(camera, fx=focal, fy=focal)
        focal_sd = max(angles.focal_sd, _LINES_FOCAL_SD)
        hfov = Assumed(value=camera.hfov, sd=focal_sd * math.sin(camera.hfov), source="estimated")
    origin = "was estimated from all photographs of the turn"
    if not _is_possible(photograph, camera, pitch.value, roll.value):
        assert photograph.camera is not None
        camera, hfov, pitch, roll = photograph.camera, photograph.hfov, photograph.pitch, photograph.roll
        origin = "was estimated from straight lines"
    if hfov.source == "estimated":
        warnings = (*warnings, field_warning(hfov.value, hfov.sd, origin))
    rows, columns = photograph.overview.picture.shape[:2]
    small, tilt = camera.scaled(columns, rows), {"pitch": pitch.value, "roll": roll.value}
    return replace(
        photograph,
        hfov=hfov,
        pitch=pitch,
        roll=roll,
        azimuths=seen_azimuths(small, **tilt),
        patches=cut_patches(photograph.overview.picture, small, **tilt, size=size),
        camera=camera,
        axes=camera_axes(**tilt),
        overview=None,
        warnings=warnings,
    )


def _is_possible(photograph: Photograph, camera: Camera, pitch: float, roll: float) -> bool:
    """Return whether a photograph can have a camera and a tilt."""
    low, high = HFOV_RANGE_DEG[photograph.projection]
    is_tilted = abs(math.degrees(pitch)) > MAX_PITCH_DEG or abs(math.degrees(roll)) > MAX_ROLL_DEG
    return not is_tilted and low <= math.degrees(camera.hfov) <= high
