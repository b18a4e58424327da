"""Predictions of a model on annotated photographs, per azimuth: walls and openings, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import BundleError
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph
from lalaloc_core.learn.metrics import AzimuthMeasures, measure_azimuths
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight


@dataclass(frozen=True, eq=False, kw_only=True)
class ReadPhotograph:
    """Photograph with its predicted walls and openings.

    `class_scores` are predicted log likelihoods up to a constant; None if the model predicts none.
    """

    photograph: AnnotatedPhotograph
    profile_m: Float[np.ndarray, "w"]
    class_scores: Float[np.ndarray, "w c"] | None
    measures: AzimuthMeasures


def read_photographs(encoders: PhotographEncoder, photographs: Sequence[AnnotatedPhotograph]) -> list[ReadPhotograph]:
    """Predict walls and openings of each photograph and compare them with the annotation.

    Raises:
        BundleError: the model predicts no wall profile.
        DatasetError: a photograph cannot be read.
    """
    manifest = encoders.manifest
    read = []
    for photograph in photographs:
        image = photograph.photograph.image(manifest.image_height, manifest.image_width)
        log_m, log_scale, scores = read_azimuths(encoders, image, CAMERA_HEIGHT_M)
        measures = measure_azimuths(
            [photograph.profile_m(outline, len(log_m)) for outline in range(len(photograph.outlines))],
            log_m,
            log_scale,
            photograph.classes(len(log_m)),
            scores,
        )
        read.append(
            ReadPhotograph(photograph=photograph, profile_m=np.exp(log_m), class_scores=scores, measures=measures)
        )
    return read


def read_azimuths(
    encoders: PhotographEncoder, image: UInt8[np.ndarray, "height width 3"], camera_height_m: float
) -> tuple[Float[np.ndarray, "w"], Float[np.ndarray, "w"], Float[np.ndarray, "w c"] | None]:
    """Predict walls and openings of a panorama in its own frame.

    Returns:
        the log of the predicted wall profile (m), the log of its scale, and `ReadPhotograph.class_scores`.

    Raises:
        BundleError: the model predicts no wall profile.
    """
    query = encoders.spheres.query(image, 0.0, CameraHeight(camera_height_m, 0.0))
    if query.profile is None:
        raise BundleError(f"model '{encoders.manifest.name}' predicts no wall profile; use another bundle")
    # Relative to the shares of the classes, as in the matching cost, so that every class counts alike.
    openings = query.openings
    scores = None if openings is None else openings.log_probability[0] - np.log(openings.prior)
    return query.profile.log_m[0], query.profile.log_scale[0], scores
