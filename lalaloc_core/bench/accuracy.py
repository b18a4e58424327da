"""How well the shipped model does on homes that training never draws."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluation.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluation.run import run_evaluation
from lalaloc_core.evaluation.score import StageScores, score
from lalaloc_core.methods.method import QueryKind

# Homes of what is not among the first figures, and of the comparison of evidence, which asks the same six times.
_MAX_HOMES_OF_MINOR = 100
_MAX_HOMES_PER_EVIDENCE = 50


@dataclass(frozen=True, kw_only=True)
class _Benchmark:
    """What is asked of the model; `unfamiliar`: in homes that another generator than training's drew.

    Of a `minor` benchmark fewer homes are asked.
    """

    kind: QueryKind = "panorama"
    furniture: str = "full"
    heading_known: bool = True
    unfamiliar: bool = False
    evidence: str = "profile"
    minor: bool = False


_BENCHMARKS = {
    "layout": _Benchmark(kind="layout"),
    "panorama_full": _Benchmark(),
    "panorama_empty": _Benchmark(furniture="empty", minor=True),
    "panorama_full_unknown_heading": _Benchmark(heading_known=False),
    "out_of_family_full": _Benchmark(unfamiliar=True, minor=True),
    "out_of_family_empty": _Benchmark(unfamiliar=True, furniture="empty", minor=True),
}


def bench_accuracy(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Accuracy on generated test homes, 4 queries each, and on at most 100 unfurnished and out-of-family ones."""
    return {name: _summary(_answers(bundle, benchmark, homes, textures)) for name, benchmark in _BENCHMARKS.items()}


def bench_evidence(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """What poses are compared by: the latent, the predicted wall profile, or both; heading known and unknown."""
    homes = min(homes, _MAX_HOMES_PER_EVIDENCE)
    return {
        heading: {
            evidence: _summary(
                _answers(
                    bundle, _Benchmark(evidence=evidence, heading_known=heading == "known_heading"), homes, textures
                )
            )
            for evidence in ("latent", "profile", "both")
        }
        for heading in ("known_heading", "unknown_heading")
    }


def _answers(bundle: Bundle, benchmark: _Benchmark, homes: int, textures: Path | None) -> list[Prediction]:
    homes = min(homes, _MAX_HOMES_OF_MINOR) if benchmark.minor else homes
    generated: dict[str, Any] = {"homes": homes, "furniture": benchmark.furniture}
    if benchmark.unfamiliar:
        generated["generator"] = "unfamiliar"
    else:
        generated["textures"] = None if textures is None else str(textures)
    info = RunInfo(
        label=f"{benchmark.kind}, {benchmark.furniture}",
        method="lalaloc",
        kind=benchmark.kind,
        dataset="out-of-family homes" if benchmark.unfamiliar else "generated homes",
        split="test",
        settings={"evidence": benchmark.evidence},
        generated=generated,
        bundle=str(bundle.folder),
        furniture=benchmark.furniture if benchmark.kind == "panorama" else None,
        heading_known=benchmark.heading_known,
    )
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as folder:
        return run_evaluation(RunFolder(Path(folder)), info)


def _summary(predictions: list[Prediction]) -> dict[str, Any]:
    """The figures that tables show."""
    scores = score(predictions)
    shares = ("within_1cm", "within_5cm", "within_10cm", "within_1m")

    def figures(stage: StageScores) -> dict[str, float]:
        return {name: getattr(stage, name).value for name in ("median_cm", *shares)}

    interval = scores.final.within_1m
    return {
        "n": scores.n,
        **figures(scores.final),
        "within_1m_interval": [interval.low, interval.high],
        "retrieval": figures(scores.stages["retrieval"]),
        "correct_room": scores.final.correct_room.value,
        "heading_within_2deg": scores.final.heading_within_2deg.value,
        "median_ms": scores.median_ms,
        "expected_calibration_error": scores.calibration_error,
    }
