"""Accuracy of the shipped model on homes that training never draws: by task, matching cost, term and camera height."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import StageScores, score
from lalaloc_core.learn.data.views import Stated

# Limits for minor figures, and for the comparison of matching costs, which repeats its queries six times.
_MAX_MINOR_HOMES = 100
_MAX_EVIDENCE_HOMES = 50


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Queries for the model.

    `heldout` homes are out-of-distribution ones; `copies` makes plans of four copies of a home that differ in their
    doors; a `minor` benchmark needs fewer homes. `view_deg` is the field of view of the photographs, None for spheres,
    and `stated` what is known of it. `settings` are those of method "lalaloc".
    """

    kind: QueryKind = "photograph"
    furniture: str = "full"
    heading_known: bool = True
    heldout: bool = False
    copies: bool = False
    view_deg: float | None = None
    stated: Stated = "field"
    settings: Mapping[str, Any] = field(default_factory=dict)
    minor: bool = False


_BENCHMARKS = {
    "layout": Benchmark(kind="layout"),
    "sphere_full": Benchmark(),
    "sphere_empty": Benchmark(furniture="empty", minor=True),
    "sphere_full_unknown_heading": Benchmark(heading_known=False),
    "heldout_full": Benchmark(heldout=True, minor=True),
    "heldout_full_unknown_heading": Benchmark(heldout=True, heading_known=False, minor=True),
    "heldout_empty": Benchmark(heldout=True, furniture="empty", minor=True),
}

_VIEW_BENCHMARKS = {
    "view_60_unknown_heading": Benchmark(view_deg=60.0, heading_known=False, minor=True),
    "view_80_unknown_heading": Benchmark(view_deg=80.0, heading_known=False, minor=True),
    "view_80_known_tilt": Benchmark(view_deg=80.0, heading_known=False, stated="tilt", minor=True),
    "view_80_unknown_field": Benchmark(view_deg=80.0, heading_known=False, stated="nothing", minor=True),
    "view_80_heading_within_10_deg": Benchmark(view_deg=80.0, settings={"heading_error_deg": 10.0}, minor=True),
    "view_106_unknown_heading": Benchmark(view_deg=106.0, heading_known=False, minor=True),
    "heldout_view_80_unknown_heading": Benchmark(view_deg=80.0, heading_known=False, heldout=True, minor=True),
    "heldout_view_106_unknown_heading": Benchmark(view_deg=106.0, heading_known=False, heldout=True, minor=True),
}


_HEADINGS = {"known_heading": True, "unknown_heading": False}


def bench_accuracy(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy in generated test homes, 4 queries each; in at most 100 unfurnished and heldout ones."""
    return _figures(bundle, _BENCHMARKS, homes, textures)


def bench_views(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy of views in at most 100 furnished test and out-of-distribution homes, 4 queries each."""
    return _figures(bundle, _VIEW_BENCHMARKS, homes, textures)


def bench_evidence(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy with the latent, the predicted wall profile, or both in the matching cost."""
    homes = min(homes, _MAX_EVIDENCE_HOMES)
    return {
        heading: _figures(
            bundle,
            {
                term: Benchmark(settings={"evidence": term}, heading_known=known)
                for term in ("latent", "profile", "both")
            },
            homes,
            textures,
        )
        for heading, known in _HEADINGS.items()
    }


def _figures(bundle: Bundle, benchmarks: Mapping[str, Benchmark], homes: int, textures: Path | None) -> dict[str, Any]:
    return {
        name: summarise(run_benchmark(bundle, benchmark, homes, textures)) for name, benchmark in benchmarks.items()
    }


def run_benchmark(bundle: Bundle, benchmark: Benchmark, homes: int, textures: Path | None) -> list[Prediction]:
    """Return the predictions of a benchmark, 4 queries in each home."""
    homes = min(homes, _MAX_MINOR_HOMES) if benchmark.minor else homes
    generated: dict[str, Any] = {"homes": homes, "furniture": benchmark.furniture}
    if benchmark.heldout:
        generated["generator"] = "heldout"
    else:
        generated["textures"] = None if textures is None else str(textures)
    if benchmark.copies:
        generated["generator"] = "copies"
    info = RunInfo(
        label=f"{benchmark.kind}, {benchmark.furniture}",
        kind=benchmark.kind,
        dataset="out-of-distribution homes" if benchmark.heldout else "generated homes",
        split="test",
        settings=dict(benchmark.settings),
        generated=generated,
        views=None if benchmark.view_deg is None else {"field_deg": benchmark.view_deg, "stated": benchmark.stated},
        bundle=str(bundle.folder),
        furniture=benchmark.furniture if benchmark.kind == "photograph" else None,
        heading_known=benchmark.heading_known,
    )
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as folder:
        return run_evaluation(RunFolder(Path(folder)), info)


def summarise(predictions: list[Prediction]) -> dict[str, Any]:
    """Return the figures of some predictions that tables show."""
    scores = score(predictions)
    shares = ("within_1cm", "within_5cm", "within_10cm", "within_1m")

    def figures(stage: StageScores) -> dict[str, float]:
        return {name: getattr(stage, name).value for name in ("median_cm", *shares)}

    interval = scores.final.within_1m
    return {
        "n": scores.n,
        **figures(scores.final),
        "within_1m_interval": [interval.low, interval.high],
        "within_1m_30deg": scores.final.within_1m_30deg.value,
        "among_5": float(np.mean([is_among(prediction, 5) for prediction in predictions])),
        "retrieval": figures(scores.stages["retrieval"]),
        "correct_room": scores.final.correct_room.value,
        "heading_within_2deg": scores.final.heading_within_2deg.value,
        "median_ms": scores.median_ms,
        "expected_calibration_error": scores.calibration_error,
    }


def is_among(prediction: Prediction, count: int) -> bool:
    """Return whether one of the first candidates is within 1 m of the truth."""
    truth = prediction.truth
    poses = [candidate.pose for candidate in prediction.candidates[:count]]
    return any(math.hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m) < 1.0 for pose in poses)


# Settings of method "lalaloc" by row. Terms that a plan or a model lacks have no effect.
TERMS: Mapping[str, Mapping[str, Any]] = {
    "all": {},
    "without_openings": {"openings": False},
    "without_see_through": {"see_through": False},
    "without_ceiling": {"ceiling": False},
    "without_room_type": {"room_type": False},
    "walls_alone": {"openings": False, "see_through": False, "ceiling": False, "room_type": False},
}
HEIGHTS: Mapping[str, Mapping[str, Any]] = {
    "right": {},
    "20_cm_too_high": {"camera_height_error_m": 0.2},
    "20_cm_too_low": {"camera_height_error_m": -0.2},
    "unknown": {"camera_height": "unknown"},
}


def bench_terms(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy with and without each term of the matching cost, in test and out-of-distribution homes."""
    return {
        family: _rows(bundle, TERMS, homes, textures, heldout=heldout)
        for family, heldout in (("test", False), ("heldout", True))
    }


def bench_heights(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy in test homes with a right, a wrong and an unknown camera height."""
    return {"test": _rows(bundle, HEIGHTS, homes, textures, heldout=False)}


def bench_copies(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure accuracy in plans of four copies of a home that differ in their doors, with and without openings."""
    rows = {name: TERMS[name] for name in ("all", "without_openings")}
    return {"test": _rows(bundle, rows, homes, textures, heldout=False, copies=True)}


def _rows(
    bundle: Bundle,
    rows: Mapping[str, Mapping[str, Any]],
    homes: int,
    textures: Path | None,
    *,
    heldout: bool,
    copies: bool = False,
) -> dict[str, Any]:
    """Return the figures by row and heading."""
    common: dict[str, Any] = {"heldout": heldout, "copies": copies, "minor": heldout or copies}
    return {
        name: _figures(
            bundle,
            {heading: Benchmark(settings=row, heading_known=known, **common) for heading, known in _HEADINGS.items()},
            homes,
            textures,
        )
        for name, row in rows.items()
    }
