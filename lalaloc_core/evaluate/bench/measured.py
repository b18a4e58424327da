"""Setting of a benchmark, and the summary of its answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.runs.score import expected_calibration_error
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.synth.scene.shots import Shot
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.search.pipeline import Localisation


@dataclass(frozen=True)
class Setting:
    """A bundle, the number of test homes, and folders of textures for the renderer and of annotated photographs."""

    bundle: Bundle
    homes: int
    textures: Path | None = None
    annotated: Path | None = None

    @cached_property
    def model(self) -> LocalModel:
        """The bundle, ready to localise."""
        return LocalModel(self.bundle)


class Found(NamedTuple):
    """Errors of an answer's position (m) and heading (radians), and its confidence; NaN without one."""

    error_m: float
    turned: float
    confidence: float

    @classmethod
    def of(cls, found: Localisation, camera: Camera | Shot, confidence: float | None, turn: float = 0.0) -> Found:
        """Compare an answer with the pose of a camera, from whose heading the photograph is turned."""
        answer = found.candidates[0]
        turned = photograph_heading(found.query, answer) - camera.heading - turn
        error_m = float(np.linalg.norm(answer.position_m - camera.position_m))
        return cls(error_m, abs(float(wrap_angle(turned))), math.nan if confidence is None else confidence)


def summary(answers: Sequence[Found]) -> dict[str, float]:
    """Return the figures of some answers."""
    error_m, turned, confidence = np.array(answers).T
    near = error_m < 1.0
    return {
        "n": len(answers),
        "within_1m": float(near.mean()),
        "within_1m_30deg": float((near & (turned < math.radians(30.0))).mean()),
        "median_cm": 100.0 * float(np.median(error_m)),
        "mean_confidence": float(confidence.mean()),
        "expected_calibration_error": expected_calibration_error(confidence, near),
    }
