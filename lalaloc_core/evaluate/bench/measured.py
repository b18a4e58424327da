"""Setting of a benchmark, what benchmarks localise, and the summary of their answers."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.evaluate.methods.lalaloc import found_pose
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import expected_calibration_error
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RendererCache, split_renderer_cache
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.search.pipeline import Localisation

_SPLIT = SPLIT_NUMBERS["test"]
_T = TypeVar("_T")


@dataclass(frozen=True)
class Setting:
    """A bundle, the number of test homes, and folders.

    Attributes:
        textures: textures for the renderer.
        data: pictures by others: `annotated` and `rendered_house`.
        rooms: path-traced rooms (`posed_spheres`).
    """

    bundle: Bundle
    homes: int
    textures: Path | None = None
    data: Path | None = None
    rooms: Path | None = None

    @property
    def annotated(self) -> Path | None:
        """Folder of annotated photographs."""
        return self._folder("annotated")

    @property
    def house(self) -> Path | None:
        """Folder of the rendered house."""
        return self._folder("rendered_house")

    def _folder(self, name: str) -> Path | None:
        return self.data / name if self.data is not None and (self.data / name).is_dir() else None

    @cached_property
    def model(self) -> LocalModel:
        """The bundle, ready to localise."""
        return LocalModel(self.bundle)

    @cached_property
    def renderers(self) -> RendererCache:
        """Renderers of the test split."""
        return split_renderer_cache(_SPLIT, 0, self.textures)

    def shots(self, per_home: int) -> Iterator[tuple[list[Shot], np.random.Generator]]:
        """Yield shots of each furnished test home, and the home's random numbers."""
        for index in range(self.homes):
            home, rng = home_of(_SPLIT, 0, index)
            yield sample_shots(home, per_home, rng, "full"), rng


def evaluate(info: RunInfo) -> list[Prediction]:
    """Return the predictions of a run that is not kept."""
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as folder:
        return run_evaluation(RunFolder(Path(folder)), info)


def timed(call: Callable[..., _T], *arguments: Any) -> tuple[float, _T]:
    """Return the duration (s) and the result of a call."""
    begin = time.perf_counter()
    result = call(*arguments)
    return time.perf_counter() - begin, result


def best_pose(found: Localisation) -> Pose:
    """Return the pose of an answer."""
    return found_pose(found.query, found.candidates[0])


class Found(NamedTuple):
    """Errors of an answer's position (m) and heading (radians), its confidence, NaN without one, and right room."""

    error_m: float
    turned: float
    confidence: float
    right_room: bool

    @classmethod
    def of(cls, pose: Pose | None, truth: Pose | Camera | Shot, confidence: float | None) -> Found:
        """Compare a pose with the true one; None is a miss."""
        if pose is None:
            return cls(math.inf, math.inf, 0.0, right_room=False)
        turned = abs(float(wrap_angle(pose.heading - truth.heading)))
        error_m = float(np.linalg.norm(pose.position_m - truth.position_m))
        known = math.nan if confidence is None else confidence
        return cls(error_m, turned, known, pose.room_index == truth.room_index)


def summary(answers: Sequence[Found]) -> dict[str, float]:
    """Return the figures of some answers."""
    error_m, turned, confidence, _ = np.array(answers).T
    near = error_m < 1.0
    return {
        "n": len(answers),
        "within_1m": float(near.mean()),
        "within_1m_30deg": float((near & (turned < math.radians(30.0))).mean()),
        "median_cm": 100.0 * float(np.median(error_m)),
        "mean_confidence": float(confidence.mean()),
        "expected_calibration_error": expected_calibration_error(confidence, near),
    }


def means(rows: Sequence[Any]) -> dict[str, float]:
    """Return the number of rows, named tuples of one kind, and the mean of each figure."""
    named = zip(rows[0]._fields, np.mean(rows, axis=0).tolist(), strict=True) if rows else ()
    return {"n": len(rows), **dict(named)}
