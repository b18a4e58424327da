"""Annotated photographs in plans: retrieval of their own room among similar ones, and confidence in other buildings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import expected_calibration_error, heading_errors_deg, position_errors_m
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import CAMERA_HEIGHT_M, AnnotatedPhotograph, HeldoutScenes
from lalaloc_core.learn.data.annotated import GalleryKey
from lalaloc_core.learn.data.synthetic.altered_homes import office_plan, without_openings
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight

# A position is right within this distance or this share of the room's size (the root of its area).
NEAR_M, NEAR_SHARE = 0.5, 0.1
# A symmetric room has two headings for one position.
_MAX_HEADING_ERROR_DEG = 10.0
# Rank of a room without a candidate.
_NOT_RANKED = 1_000


@dataclass(frozen=True, kw_only=True)
class GalleryAnswer:
    """Result of one photograph in one gallery, for the outline with the better result.

    Attributes:
        turned: whether it is located with a heading error above 10°.
        rank: rank of the best candidate in the right room, from 1; None without one.
        error_m: position error; infinite without an answer.
        within_1m: the event whose probability `confidence` is.
    """

    photograph: str
    gallery: int
    outline: int
    located: bool
    turned: bool
    right_room: bool
    rank: int | None
    error_m: float
    within_1m: bool
    confidence: float | None

    @property
    def merit(self) -> tuple[bool, bool, int, float]:
        """Sort key: the better of two results is larger."""
        return self.located, self.right_room, -(self.rank or _NOT_RANKED), -self.error_m


@dataclass(frozen=True, kw_only=True)
class GalleryScores:
    """Shares over all galleries of all photographs; `turned` are located with a wrong heading."""

    photographs: int
    galleries: int
    located: float
    turned: float
    right_room: float
    among_3: float
    among_5: float
    calibration_error: float | None
    by_photograph: Mapping[str, float]


def answers_in_galleries(
    predictions: Sequence[Prediction], photographs: Sequence[AnnotatedPhotograph]
) -> list[GalleryAnswer]:
    """Return one result for every gallery of every photograph, or of each of its views, in order."""
    by_name = {photograph.name: photograph for photograph in photographs}
    errors_m = np.nan_to_num(position_errors_m(predictions), nan=np.inf)
    headings_deg = heading_errors_deg(predictions)
    best: dict[tuple[str, int], GalleryAnswer] = {}
    for prediction, error_m, heading_deg in zip(predictions, errors_m, headings_deg, strict=True):
        key = GalleryKey.from_scene(prediction.scene)
        assert key is not None, f"'{prediction.scene}' is not a gallery"
        size_m = by_name[key.photograph].outlines[key.outline].size_m
        pose = prediction.final_pose
        right_room = pose is not None and pose.room_index == prediction.truth.room_index
        located = right_room and bool(error_m < max(NEAR_M, NEAR_SHARE * size_m))
        answer = GalleryAnswer(
            photograph=key.photograph,
            gallery=key.gallery,
            outline=key.outline,
            located=located,
            turned=located and bool(heading_deg > _MAX_HEADING_ERROR_DEG),
            right_room=right_room,
            rank=prediction.room_rank,
            error_m=float(error_m),
            within_1m=bool(error_m < 1.0),
            confidence=prediction.confidence,
        )
        slot = prediction.camera, key.gallery
        if slot not in best or answer.merit > best[slot].merit:
            best[slot] = answer
    return list(best.values())


def score_galleries(answers: Sequence[GalleryAnswer]) -> GalleryScores:
    """Return the scores of at least one result."""
    confident = [answer for answer in answers if answer.confidence is not None]
    error = None
    if confident:
        confidence = np.array([answer.confidence for answer in confident], dtype=float)
        error = expected_calibration_error(confidence, np.array([answer.within_1m for answer in confident]))
    names = list(dict.fromkeys(answer.photograph for answer in answers))
    return GalleryScores(
        photographs=len(names),
        galleries=len(answers),
        located=float(np.mean([answer.located for answer in answers])),
        turned=float(np.mean([answer.turned for answer in answers])),
        right_room=float(np.mean([answer.right_room for answer in answers])),
        among_3=_among(answers, 3),
        among_5=_among(answers, 5),
        calibration_error=error,
        by_photograph={
            name: float(np.mean([answer.located for answer in answers if answer.photograph == name])) for name in names
        },
    )


def _among(answers: Sequence[GalleryAnswer], count: int) -> float:
    """Return the share with the right room among so many candidates."""
    return float(np.mean([answer.rank is not None and answer.rank <= count for answer in answers]))


def describe_answers(answers: Sequence[GalleryAnswer], photograph: str) -> str:
    """Describe the number of galleries that locate a photograph, and its room's ranks in the others."""
    own = [answer for answer in answers if answer.photograph == photograph]
    if not own:
        return "not evaluated"
    missed = [f"{answer.rank or 'none'}" for answer in own if not answer.located]
    return f"{len(own) - len(missed)} of {len(own)}" + (f" (ranks {', '.join(missed)})" if missed else "")


# Five homes and five offices, each with and without openings; the fit of the confidence has other ones.
_EACH, _OFFICES = 5, 77
# Confidence above which a photograph counts as accepted.
ACCEPTED = 0.5


def foreign_plans() -> list[FloorPlan]:
    """Return out-of-distribution homes and offices, each with openings and then without."""
    heldout = HeldoutScenes(homes=_EACH)
    homes = [heldout.load(name).plan for name in heldout.scenes("test")]
    offices = [office_plan(np.random.default_rng([_OFFICES, index])) for index in range(_EACH)]
    return [drawn for plan in homes + offices for drawn in (plan, without_openings(plan))]


def foreign_confidences(
    bundle: Bundle, photographs: Sequence[AnnotatedPhotograph], plans: Sequence[FloorPlan], *, heading_known: bool
) -> list[float]:
    """Return the confidence of photographs in plans; a known heading is one parallel to the plan's axes."""
    if bundle.manifest.confidence is None:
        return []
    model = LocalModel(bundle)
    height, size = CameraHeight(CAMERA_HEIGHT_M), (bundle.manifest.image_height, bundle.manifest.image_width)
    images = [photograph.photograph.image(*size) for photograph in photographs]
    found = []
    for plan in plans:
        grid = model.grid(plan, CAMERA_HEIGHT_M)
        for photograph, image in zip(photographs, images, strict=True):
            heading = photograph.outlines[0].main_direction if heading_known else None
            answer = model.localise(plan, grid, model.encoder.spheres.query(image, heading, height))
            confidence = answer.confidence(bundle.manifest.confidence)
            if confidence is not None:
                found.append(confidence.position)
    return found
