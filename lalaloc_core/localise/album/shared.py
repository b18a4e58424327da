"""Unknowns that the photographs of an album share: fields of view, the camera's height, and the scale of the plan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.memory import Arrays
from lalaloc_core.localise.album.pins import SharedCamera
from lalaloc_core.localise.album.single import OFFSETS, USUAL_HEIGHT_M, USUAL_LOG_SD
from lalaloc_core.localise.query import DEFAULT_STD_M

# Standard deviation of the scale of a plan; of the log height from one photograph to the next; and of a median over
# that of a mean. Errors of fields of view by lines are alike, so the error of many is not less than `_LINES_SD`.
_SCALE_SD, _HAND_SD, _MEDIAN, _LINES_SD = 0.05, 0.05, 1.25, 0.03


def shared_cameras(photographs: Sequence[AlbumPhotograph]) -> tuple[SharedCamera, ...]:
    """Return the cameras of an album, with the field of view by all photographs of each."""
    groups: dict[tuple[str, str, int, int], list[AlbumPhotograph]] = {}
    for photograph in photographs:
        if not photograph.view.is_sphere:
            groups.setdefault(photograph.camera_key, []).append(photograph)
    found = []
    for (make, model, short, long), members in groups.items():
        stated = [each for each in members if each.has_stated_field]
        half = np.array([min(0.5 * each.view.hfov.value, 1.5) for each in stated or members])
        log_tangent = np.log(np.tan(half))
        spread = float(np.median(np.abs(log_tangent - np.median(log_tangent)))) * 1.48
        hfov = 2.0 * math.atan(math.exp(float(np.median(log_tangent))))
        sd = 0.0 if len(stated) == len(members) else math.hypot(_MEDIAN * spread / math.sqrt(len(half)), _LINES_SD)
        found.append(
            SharedCamera(
                make=make,
                model=model,
                width=short,
                height=long,
                photographs=len(members),
                hfov=hfov,
                hfov_sd=sd * math.sin(hfov),
            )
        )
    return tuple(found)


def camera_height(ground: AlbumGround, evidence: Sequence[Arrays]) -> tuple[float, float, float, float]:
    """Return the height of the cameras (m) and the scale of the plan, each followed by its standard deviation.

    Photographs tell the height in units of the plan, so one factor is divided between both by what is known of each.
    """
    total = np.zeros(len(OFFSETS))
    usual = -0.5 * np.square(OFFSETS / USUAL_LOG_SD)
    spread = np.exp(-0.5 * np.square((OFFSETS[:, None] - OFFSETS) / _HAND_SD))
    for arrays in evidence:
        alone = arrays["heights"] - usual
        total += np.log(spread @ np.exp(alone - alone.max()) + 1e-3)
    plan = ground.plan
    prior_m = plan.camera_height_m if plan.states_camera_height else USUAL_HEIGHT_M
    stated_sd_m = DEFAULT_STD_M if plan.camera_height_std_m is None else plan.camera_height_std_m
    log_sd = max(stated_sd_m / prior_m, 1e-3) if plan.states_camera_height else USUAL_LOG_SD
    prior = math.log(prior_m / USUAL_HEIGHT_M)
    total -= 0.5 * np.square(OFFSETS - prior) / (log_sd**2 + _SCALE_SD**2)
    share = np.exp(total - total.max())
    share /= share.sum()
    mean = float(share @ OFFSETS)
    sd = math.sqrt(float(share @ np.square(OFFSETS - mean)) + (OFFSETS[1] - OFFSETS[0]) ** 2 / 12.0)
    # A higher camera and a smaller plan look the same.
    part = _SCALE_SD**2 / (log_sd**2 + _SCALE_SD**2)
    moved = mean - prior
    height_m = prior_m * math.exp((1.0 - part) * moved)
    left = math.sqrt((1.0 - part) * _SCALE_SD**2)
    return (
        height_m,
        height_m * math.hypot(left, (1.0 - part) * sd),
        math.exp(-part * moved),
        math.hypot(left, part * sd),
    )
