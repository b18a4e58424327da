"""What image encoders say of a panorama."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class StructureFeatures:
    """What an image encoder says of a panorama besides the distance of the walls.

    Attributes:
        opening_logits: (b, w, classes) of what is met at each azimuth, in the order of `conventions.OPENING_CLASSES`.
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
    """What the image encoder says of a panorama.

    Attributes:
        ring: (b, c, s) features to be compared with the layout encoder's.
        log_profile: (b, w) log of the predicted wall profile (m).
        log_scale: (b, w) log of the scale of the Laplace distribution of `log_profile`'s error.
        structure: what an encoder that tells openings, ceiling and type of the room says of them.
    """

    ring: Tensor
    log_profile: Tensor
    log_scale: Tensor
    structure: StructureFeatures | None = None


def first_rows(seen: ImageFeatures, count: int) -> ImageFeatures:
    """What was said of the first `count` panoramas of a batch."""
    structure = seen.structure
    if structure is not None:
        structure = StructureFeatures(**{name: value[:count] for name, value in vars(structure).items()})
    return ImageFeatures(seen.ring[:count], seen.log_profile[:count], seen.log_scale[:count], structure)
