"""Accuracy with several views from one spot, turned by known or unknown angles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.calibrate.measured_errors import Spot, photograph_of, spots
from lalaloc_core.evaluate.runs.score import expected_calibration_error
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.sequence.joint_refinement import refine_sequence
from lalaloc_core.localise.sequence.measured_motion import Motion
from lalaloc_core.localise.sequence.sequence_search import localise_sequence
from lalaloc_core.localise.sequence.turn_localisation import found_turns, judged_turn

# Photographs taken while turning on the spot are this close together (m).
_TURNED_STD_M = 0.1


class _Answer(NamedTuple):
    """Errors of the position (m) and of the heading (radians), and the confidence."""

    error_m: float
    turned: float
    confidence: float


def bench_turns(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy of three views of 80°, a third of a turn apart, in furnished test homes, 4 spots each.

    The heading is unknown, and so are the angles between the views, unless the row says that they are known.
    """
    model = LocalModel(bundle)
    answers: dict[str, list[_Answer]] = {}
    for spot in spots(homes, "test", textures):
        for row, answer in _at_spot(spot, model).items():
            answers.setdefault(row, []).append(answer)
    return {row: _summary(found) for row, found in answers.items()}


def _at_spot(spot: Spot, model: LocalModel) -> dict[str, _Answer]:
    """Localise the views of one spot with known and with unknown angles between them."""
    (plan, views), encoder, manifest = spot, model.encoder, model.bundle.manifest
    height = CameraHeight(views[0].camera_height_m)
    opened = [photograph_of(view).open(patch_size(manifest)) for view in views]
    grid = model.grid(plan, height.height_m)

    def as_one(turns: Sequence[float]) -> Localisation:
        query = encoder.query(opened[0], None, height, others=list(zip(opened[1:], turns[1:], strict=True)))
        return model.localise(plan, grid, query)

    known = as_one(spot.turns)
    believed = known.confidence(manifest.confidence_for(view=True, turn=True))
    motions = [Motion(distance_m=0.0, distance_std_m=_TURNED_STD_M)] * (len(views) - 1)
    queries = [encoder.query(view, None, height) for view in opened]
    unknown = localise_sequence(plan, grid, model.encoder.layouts, queries, motions, refiner=refine_sequence)
    unknown = judged_turn(unknown, as_one(found_turns(unknown)))
    return {
        "known_angles": _answer(known, views[0], None if believed is None else believed.position),
        "unknown_angles": _answer(unknown.pictures[0], views[0], unknown.confidence(manifest)),
    }


def _answer(found: Localisation, camera: Camera, confidence: float | None) -> _Answer:
    answer = found.candidates[0]
    turned = abs(float(wrap_angle(photograph_heading(found.query, answer) - camera.heading)))
    error_m = float(np.linalg.norm(answer.position_m - camera.position_m))
    return _Answer(error_m, turned, np.nan if confidence is None else confidence)


def _summary(answers: Sequence[_Answer]) -> dict[str, float]:
    distance_m, turned, confidence = np.array(answers).T
    near = distance_m < 1.0
    return {
        "n": len(answers),
        "within_1m": float(near.mean()),
        "within_1m_30deg": float((near & (turned < np.radians(30.0))).mean()),
        "median_cm": 100.0 * float(np.median(distance_m)),
        "mean_confidence": float(confidence.mean()),
        "expected_calibration_error": expected_calibration_error(confidence, near),
    }
