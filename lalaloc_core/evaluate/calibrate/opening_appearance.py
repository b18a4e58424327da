"""Appearance of openings: what each class of a plan looks like in photographs, fitted on rendered ones.

The image encoder predicts the class that it sees at an azimuth. The likelihood of its prediction, given the class that
the plan shows, is a mixture over what that class may look like; expectation maximisation finds the shares.

Renderings alone say that every class looks like itself, because the encoder learnt from the same drawings. Real plans
follow other conventions, so the plans are redrawn: floor-length windows as doors, doorways without a leaf as doors, or
doors as gaps, each in some homes. Half of the result is a prior, because the renderings have no doors folded out of
sight, cupboards without fronts, or garage doors.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Integer

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import BundleError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.render.sampling import PoseSet

# Shares of homes with each convention, the sill of floor-length windows (m), and the width of doorways (m).
_PATIO_DOORS, _DOORWAYS, _GAPS = 0.5, 0.5, 0.25
_MAX_SILL_M, _MAX_DOORWAY_M = 0.1, 1.5
# Prior by rows of `conventions.OPENING_CLASSES`: wall, door, window, passage.
_PRIOR = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.2, 0.2], [0.0, 0.1, 0.9, 0.0], [0.15, 0.15, 0.0, 0.7]])
_PRIOR_SHARE = 0.5
_ITERATIONS, _DECIMALS = 200, 3


def fit_appearance(encoders: PhotographEncoder, scenes: Iterable[Scene]) -> tuple[tuple[float, ...], ...]:
    """Return `MatchingWeights.appearance`, fitted on the photographs of scenes in their redrawn plans."""
    likelihoods, classes = [], []
    for scene in scenes:
        plan = redrawn(scene.plan, zlib.crc32(scene.name.encode()))
        for camera in scene.cameras:
            for photograph in camera.photographs.values():
                image = photograph.image(encoders.manifest.image_height, encoders.manifest.image_width)
                query = encoders.spheres.query(image, camera.heading, CameraHeight(camera.camera_height_m, 0.0))
                if query.openings is None:
                    raise BundleError(f"model '{encoders.manifest.name}' predicts no openings; use another bundle")
                poses = PoseSet(camera.position_m[None], np.array([camera.room_index]))
                columns = encoders.manifest.profile_columns
                kind = layouts_at(plan, poses, np.array([query.frame_heading]), columns).kind
                likelihoods.append(np.exp(query.openings.log_probability[0]) / query.openings.prior)
                classes.append(np.zeros(columns, np.uint8) if kind is None else kind[0])
    found = mixtures(np.concatenate(likelihoods), np.concatenate(classes))
    rounded = np.round(_PRIOR_SHARE * _PRIOR + (1.0 - _PRIOR_SHARE) * found, _DECIMALS)
    return tuple(map(tuple, (rounded / rounded.sum(axis=1, keepdims=True)).tolist()))


def mixtures(likelihood: Float[np.ndarray, "n c"], drawn: Integer[np.ndarray, "n"]) -> Float[np.ndarray, "c c"]:
    """Return for every class of the plan the most likely shares of the classes seen.

    `likelihood` is that of each prediction for every class seen, and `drawn` the class in the plan. Classes that do not
    occur look like themselves.
    """
    classes = len(OPENING_CLASSES)
    shares = np.eye(classes)
    for code in np.unique(drawn):
        own, share = likelihood[drawn == code], np.full(classes, 1.0 / classes)
        for _ in range(_ITERATIONS):
            part = own * share
            share = (part / part.sum(axis=1, keepdims=True)).mean(axis=0)
        shares[code] = share
    return shares


def redrawn(plan: FloorPlan, seed: int) -> FloorPlan:
    """Return a plan with its openings drawn by other conventions, chosen by the seed."""
    patio_doors, doorways, gaps = np.random.default_rng(seed).random(3) < (_PATIO_DOORS, _DOORWAYS, _GAPS)
    document = plan.to_dict()
    for opening in document.get("openings", []):
        kind, width_m = opening["kind"], float(np.hypot(*np.subtract(*opening["line"])))
        if kind == "window" and patio_doors and opening.get("sill_m", np.inf) <= _MAX_SILL_M:
            opening["kind"] = "door"
        elif kind == "door" and gaps:
            opening["kind"] = "passage"
        elif kind == "passage" and doorways and width_m <= _MAX_DOORWAY_M:
            opening["kind"] = "door"
    return FloorPlan.from_dict(document)
