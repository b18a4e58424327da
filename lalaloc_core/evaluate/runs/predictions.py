"""Files of an evaluation run, one folder per run.

    RUN/run.json            method, data, settings, model (`RunInfo`)
    RUN/predictions.jsonl   one line per query, in order (`Prediction`)
    RUN/scores.json         scores, which need neither model nor data

Values are in metres, degrees and milliseconds; field names have the unit.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, RunError
from lalaloc_core.evaluate.methods.method import EARLIER_KINDS, Pose, PredictedCandidate, QueryKind
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.dataset import Split

RUN_FILE = "run.json"
PREDICTIONS_FILE = "predictions.jsonl"
SCORES_FILE = "scores.json"

MethodName = Literal["lalaloc", "oracle", "pose-oracle", "similarity", "icp", "explicit", "decode"]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Query and its predicted pose.

    Attributes:
        stages: the best pose after every stage ("retrieval", "vdr", "lpo", ...), in order; the last is the final
            pose. Empty without an answer, which counts as a miss.
        layout_hit: whether retrieval chose the grid pose with the nearest layout by Chamfer distance (Layout R@1);
            None for methods without retrieval.
        pose_hit: whether it chose the nearest grid pose (Pose R@1).
        room_rank: rank of the best candidate in the true room, from 1; None without one.
        signals: inputs of the confidence model by stage; see `localise.belief.confidence`.
        information: curvature of the cost at the final pose, by x and y (m) and, if searched, heading (radians).
        confidence: predicted probability of a position error below 1 m.
        heading_confidence: predicted probability of a heading error below 5°.
        room_confidence: predicted probability that the room is right; None outside albums.
        clicks: corrections that its album needs until all rooms are right; None outside albums.
    """

    scene: str
    camera: str
    room: str
    camera_height_m: float
    truth: Pose
    stages: dict[str, Pose] = field(default_factory=dict)
    layout_hit: bool | None = None
    pose_hit: bool | None = None
    room_rank: int | None = None
    signals: dict[str, dict[str, float]] = field(default_factory=dict)
    information: tuple[tuple[float, ...], ...] | None = None
    candidates: tuple[PredictedCandidate, ...] = ()
    confidence: float | None = None
    heading_confidence: float | None = None
    room_confidence: float | None = None
    clicks: int | None = None
    found_height_m: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)
    facts: tuple[str, ...] = ()

    @property
    def final_pose(self) -> Pose | None:
        """Pose after the last stage; None without an answer."""
        return next(reversed(self.stages.values()), None)

    def pose_after(self, stage: str | None) -> Pose | None:
        """Return the pose after a stage, or the final pose if the stage is None."""
        return self.final_pose if stage is None else self.stages.get(stage)


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """Description of a run, sufficient to repeat it.

    Attributes:
        data: folder of the data set; None for generated homes.
        data_format: one of `DATASET_FORMATS`; None to detect it.
        generated: arguments of the generator if `data` is None.
        views: arguments of `ViewScenes`, which cuts views of the photographs; None for whole spheres.
        albums: whether the photographs of a scene are solved together, as one album.
        furniture, lighting: appearance of the photographs; None if the data set has no such choice.
        bundle: folder of the model; None for methods without one.
        skipped: skipped scenes and cameras, with reasons.
    """

    label: str
    dataset: str
    split: Split
    method: MethodName = "lalaloc"
    kind: QueryKind = "photograph"
    settings: dict[str, Any] = field(default_factory=dict)
    data: str | None = None
    data_format: str | None = None
    generated: dict[str, Any] | None = None
    views: dict[str, Any] | None = None
    albums: bool = False
    furniture: str | None = None
    lighting: str | None = None
    heading_known: bool = True
    grid_step_m: float = 0.5
    limit: int | None = None
    bundle: str | None = None
    model: dict[str, str] | None = None
    skip_bad: bool = False
    command: str = ""
    skipped: tuple[str, ...] = ()


class RunFolder:
    """Files of one run, read and written."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read_info(self) -> RunInfo:
        """Return the description of the run."""
        path = self.path / RUN_FILE
        try:
            raw = json.loads(path.read_text(encoding="utf-8"))
            kind = raw.get("kind", "photograph")
            return build_config(RunInfo, raw | {"kind": EARLIER_KINDS.get(kind, kind)}, path=RUN_FILE)
        except OSError as error:
            raise RunError(f"no evaluation run at '{self.path}': {error.strerror} ({RUN_FILE})") from error
        except (ValueError, ConfigError) as error:
            raise RunError(f"'{path}' does not describe a run: {error}") from error

    def exists(self) -> bool:
        """Return whether the folder holds a run."""
        return (self.path / RUN_FILE).exists()

    def write_info(self, info: RunInfo) -> None:
        """Write the description of the run."""
        self.path.mkdir(parents=True, exist_ok=True)
        atomic_write(self.path / RUN_FILE, json.dumps(dataclasses.asdict(info), indent=2) + "\n")

    def remove(self) -> None:
        """Delete the run, and the folder unless it holds other files."""
        for name in (RUN_FILE, PREDICTIONS_FILE):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):
            self.path.rmdir()

    def read_predictions(self) -> list[Prediction]:
        """Return every complete prediction, without a last line that an interruption cut short."""
        path = self.path / PREDICTIONS_FILE
        if not path.exists():
            return []
        lines = path.read_text(encoding="utf-8").split("\n")
        # Text after the last line break was cut short by an interruption.
        return [self._parse(line, number) for number, line in enumerate(lines[:-1], start=1)]

    def append(self, predictions: Iterable[Prediction]) -> None:
        """Append predictions to the file."""
        text = _lines(predictions)
        with (self.path / PREDICTIONS_FILE).open("a", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    def replace(self, predictions: Iterable[Prediction]) -> None:
        """Replace the file atomically."""
        atomic_write(self.path / PREDICTIONS_FILE, _lines(predictions))

    def _parse(self, line: str, number: int) -> Prediction:
        try:
            return build_config(Prediction, json.loads(line), path=f"line {number}")
        except (ValueError, ConfigError) as error:
            raise RunError(f"'{self.path / PREDICTIONS_FILE}' line {number} is not a prediction: {error}") from error


def _lines(predictions: Iterable[Prediction]) -> str:
    return "".join(json.dumps(dataclasses.asdict(prediction), allow_nan=False) + "\n" for prediction in predictions)


def without_infinity(value: Any) -> Any:
    """Return plain data with None in place of numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: without_infinity(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinity(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
