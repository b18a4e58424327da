"""How well the shipped model does on generated test homes."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluation.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluation.run import run_evaluation
from lalaloc_core.evaluation.score import StageScores, score
from lalaloc_core.methods.method import QueryKind


def bench_accuracy(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Accuracy on generated test homes: layout queries, then furnished, empty and unknown-heading panoramas."""

    def accuracy(
        label: str, *, kind: QueryKind = "panorama", furniture: str = "full", heading_known: bool = True
    ) -> dict[str, Any]:
        generated = {"homes": homes, "furniture": furniture, "textures": None if textures is None else str(textures)}
        info = RunInfo(
            label=label,
            method="lalaloc",
            kind=kind,
            dataset="generated homes",
            split="test",
            generated=generated,
            bundle=str(bundle.folder),
            furniture=furniture if kind == "panorama" else None,
            heading_known=heading_known,
        )
        with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as folder:
            return _summary(run_evaluation(RunFolder(Path(folder)), info))

    return {
        "layout": accuracy("layout queries", kind="layout"),
        "panorama_full": accuracy("furnished"),
        "panorama_empty": accuracy("empty", furniture="empty"),
        "panorama_full_unknown_heading": accuracy("heading unknown", heading_known=False),
    }


def _summary(predictions: list[Prediction]) -> dict[str, Any]:
    """The figures that tables show, without their intervals."""
    scores = score(predictions)
    shares = ("within_1cm", "within_5cm", "within_10cm", "within_1m")

    def figures(stage: StageScores) -> dict[str, float]:
        return {name: getattr(stage, name).value for name in ("median_cm", *shares)}

    return {
        "n": scores.n,
        **figures(scores.final),
        "retrieval": figures(scores.stages["retrieval"]),
        "correct_room": scores.final.correct_room.value,
        "heading_within_2deg": scores.final.heading_within_2deg.value,
        "median_ms": scores.median_ms,
        "expected_calibration_error": scores.calibration_error,
    }
