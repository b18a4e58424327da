"""Outputs of image encoders."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class StructureFeatures:
    """Predictions besides the wall profile: openings, ceiling height and room type.

    Attributes:
        opening_logits: (b, w, classes) class of each azimuth, in the order of `conventions.OPENING_CLASSES`.
        log_ceiling: (b) log of the ceiling's height above the camera (m).
        log_ceiling_scale: (b) log of the scale of the Laplace distribution of `log_ceiling`'s error.
        room_type_logits: (b, types) in the order of `conventions.ROOM_TYPES`.
    """

    opening_logits: Tensor
    log_ceiling: Tensor
    log_ceiling_scale: Tensor
    room_type_logits: Tensor


@dataclass(frozen=True)
class ImageFeatures:
    """Predictions of an image encoder for a batch of panoramas.

    Attributes:
        ring: (b, c, s) features to compare with the layout encoder's.
        log_profile: (b, w) log of the predicted wall profile (m).
        log_scale: (b, w) log of the scale of the Laplace distribution of `log_profile`'s error.
        structure: openings, ceiling height and room type, if the encoder predicts them.
    """

    ring: Tensor
    log_profile: Tensor
    log_scale: Tensor
    structure: StructureFeatures | None = None


def first_rows(features: ImageFeatures, count: int) -> ImageFeatures:
    """Return the predictions for the first `count` panoramas of a batch."""
    structure = features.structure
    if structure is not None:
        structure = StructureFeatures(**{name: value[:count] for name, value in vars(structure).items()})
    return ImageFeatures(features.ring[:count], features.log_profile[:count], features.log_scale[:count], structure)
