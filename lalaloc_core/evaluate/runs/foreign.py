"""Confidence of annotated photographs in plans of other buildings, where no place is right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph
from lalaloc_core.learn.data.synthetic.foreign import office_plan, without_openings
from lalaloc_core.learn.heldout.homes import HomeKey, home_of
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import localise

# Five homes and five offices, each with and without openings; the fit of the confidence has other ones.
_EACH, _HOMES, _OFFICES = 5, (2, 0), 77
_GRID_STEP_M = 0.5
# Confidence above which a photograph counts as accepted.
ACCEPTED = 0.5


def foreign_plans() -> list[FloorPlan]:
    """Return out-of-distribution homes and offices, each with openings and then without."""
    homes = [home_of(HomeKey(*_HOMES, index)).plan.plan for index in range(_EACH)]
    offices = [office_plan(np.random.default_rng([_OFFICES, index])) for index in range(_EACH)]
    return [drawn for plan in homes + offices for drawn in (plan, without_openings(plan))]


def foreign_confidences(
    bundle: Bundle, photographs: Sequence[AnnotatedPhotograph], plans: Sequence[FloorPlan], *, heading_known: bool
) -> list[float]:
    """Return the confidence of every photograph in every plan; empty for a model without confidence.

    A known heading is one at which the walls of the photographed room are parallel to the plan's axes.
    """
    if bundle.manifest.confidence is None:
        return []
    encoders, refiner = PhotographEncoder(bundle, threads=1), local_refiner(bundle)
    height, size = CameraHeight(CAMERA_HEIGHT_M), (bundle.manifest.image_height, bundle.manifest.image_width)
    images = [photograph.photograph.image(*size) for photograph in photographs]
    found = []
    for plan in plans:
        latents = not encoders.predicts_profile
        grid = build_grid(plan, encoders, step_m=_GRID_STEP_M, camera_height_m=CAMERA_HEIGHT_M, latents=latents)
        for photograph, image in zip(photographs, images, strict=True):
            heading = photograph.outlines[0].main_direction if heading_known else None
            answer = localise(plan, grid, encoders, encoders.spheres.query(image, heading, height), refiner=refiner)
            confidence = answer.confidence(bundle.manifest.confidence)
            if confidence is not None:
                found.append(confidence.position)
    return found
