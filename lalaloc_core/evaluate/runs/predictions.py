"""What an evaluation leaves on disk: one folder per run, with what was asked and every answer.

    RUN/run.json            what was asked: method, data, settings, model (`RunInfo`)
    RUN/predictions.jsonl   one line per query, in order (`Prediction`)
    RUN/scores.json         written by scoring; can be made again at any time, without model or data

Files hold metres, degrees and milliseconds, as the names say.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, RunError
from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.dataset import Split

RUN_FILE = "run.json"
PREDICTIONS_FILE = "predictions.jsonl"
SCORES_FILE = "scores.json"

MethodName = Literal["lalaloc", "oracle", "pose-oracle", "similarity", "icp", "explicit", "decode"]


@dataclass(frozen=True, kw_only=True)
class Pose:
    """A pose in a plan; `distance` is how far the method's own measure says it is from the query (None: none)."""

    x_m: float
    y_m: float
    room_index: int
    heading_deg: float
    distance: float | None = None


@dataclass(frozen=True, kw_only=True)
class PredictedCandidate:
    """One candidate for an answer: its pose, what each term of the evidence says of it, and its posterior."""

    pose: Pose
    terms: dict[str, float]
    probability: float


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """One query and its answer.

    Attributes:
        scene, camera: which query.
        room: name of the true room.
        truth: the true pose.
        stages: the best pose after every stage ("retrieval", "vdr", "lpo", ...), in order; the last is the answer.
            Empty where the method had none: a miss.
        layout_hit: whether retrieval chose the grid pose whose layout is nearest the truth by Chamfer distance
            (Layout R@1); None for methods that do not retrieve.
        pose_hit: whether it chose the nearest grid pose (Pose R@1).
        room_rank: of the best candidate in the true room, from 1; None where none is in it, or the method ranks none.
        signals: by stage, what speaks for its pose and against it; see `localise.confidence`.
        information: curvature of the cost at the answer, by x and y (m) and, where it was searched, heading (radians).
        candidates: the answer and its rivals, best first, of methods that have any.
        confidence: probability, by the model, of being within 1 m.
        heading_confidence: probability, by the model, of the heading being right within 5°.
        found_height_m: the camera height that fits best, where it was solved for.
        timings_ms: per stage.
        facts: what is known to make the photograph hard, in alphabetical order; see `data.dataset.Described`.
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
    found_height_m: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)
    facts: tuple[str, ...] = ()

    @property
    def final_pose(self) -> Pose | None:
        """The pose after the last stage; None where there is no answer."""
        return next(reversed(self.stages.values()), None)


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What was asked, enough to ask again.

    Attributes:
        label: what tables call the run.
        settings: the method's own settings, plain data.
        dataset: what results are to be called, such as "Structured3D".
        data: folder of the data set as it was given; None for generated homes.
        data_format: which of `DATASET_FORMATS` that is; None where it is found out.
        generated: arguments of the generator where `data` is None.
        furniture, lighting: the appearance of the photographs; None where the data set has none.
        limit: at most so many queries; None for all.
        bundle: folder of the model as it was given; None for methods without one.
        model: name, version and SHA-256 of the bundle.
        skip_bad: whether scenes and cameras that cannot be used are left out instead of ending the run.
        command: how to run it again.
        skipped: scenes and cameras that could not be used, with reasons.
    """

    label: str
    method: MethodName
    kind: QueryKind
    dataset: str
    split: Split
    settings: dict[str, Any] = field(default_factory=dict)
    data: str | None = None
    data_format: str | None = None
    generated: dict[str, Any] | None = None
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
    """Reads and writes the files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read_info(self) -> RunInfo:
        """What was asked.

        Raises:
            RunError: no run there, or not one this version reads.
        """
        path = self.path / RUN_FILE
        try:
            return build_config(RunInfo, json.loads(path.read_text(encoding="utf-8")), path=RUN_FILE)
        except OSError as error:
            raise RunError(f"no evaluation run at '{self.path}': {error.strerror} ({RUN_FILE})") from error
        except (ValueError, ConfigError) as error:
            raise RunError(f"'{path}' does not describe a run: {error}") from error

    def exists(self) -> bool:
        """Whether a run was begun here."""
        return (self.path / RUN_FILE).exists()

    def write_info(self, info: RunInfo) -> None:
        """Record what is asked."""
        self.path.mkdir(parents=True, exist_ok=True)
        atomic_write(self.path / RUN_FILE, json.dumps(dataclasses.asdict(info), indent=2) + "\n")

    def remove(self) -> None:
        """Take the run away, and the folder with it unless something else lies there."""
        for name in (RUN_FILE, PREDICTIONS_FILE):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):
            self.path.rmdir()

    def read_predictions(self) -> list[Prediction]:
        """Every complete answer; a last line that an interruption cut short is left out.

        Raises:
            RunError: a line that is not a prediction.
        """
        path = self.path / PREDICTIONS_FILE
        if not path.exists():
            return []
        lines = path.read_text(encoding="utf-8").split("\n")
        # What stands after the last line break was being written when the run was interrupted.
        return [self._parse(line, number) for number, line in enumerate(lines[:-1], start=1)]

    def append(self, predictions: Iterable[Prediction]) -> None:
        """Add answers at the end of the file."""
        text = _lines(predictions)
        with (self.path / PREDICTIONS_FILE).open("a", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    def replace(self, predictions: Iterable[Prediction]) -> None:
        """Replace the file's content, atomically."""
        atomic_write(self.path / PREDICTIONS_FILE, _lines(predictions))

    def _parse(self, line: str, number: int) -> Prediction:
        try:
            return build_config(Prediction, json.loads(line), path=f"line {number}")
        except (ValueError, ConfigError) as error:
            raise RunError(f"'{self.path / PREDICTIONS_FILE}' line {number} is no prediction: {error}") from error


def read_runs(folders: Iterable[Path]) -> Iterator[tuple[RunInfo, list[Prediction]]]:
    """What several runs asked and answered."""
    for folder in folders:
        run = RunFolder(folder)
        yield run.read_info(), run.read_predictions()


def _lines(predictions: Iterable[Prediction]) -> str:
    return "".join(json.dumps(dataclasses.asdict(one), allow_nan=False) + "\n" for one in predictions)


def without_infinity(value: Any) -> Any:
    """Plain data as JSON can hold it: numbers that are not finite become None."""
    if isinstance(value, dict):
        return {key: without_infinity(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinity(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
