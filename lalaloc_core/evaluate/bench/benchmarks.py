"""Report of all groups of benchmarks."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.bench.accuracy import (
    bench_accuracy,
    bench_copies,
    bench_evidence,
    bench_heights,
    bench_terms,
    bench_views,
)
from lalaloc_core.evaluate.bench.albums import bench_albums
from lalaloc_core.evaluate.bench.azimuths import bench_azimuths
from lalaloc_core.evaluate.bench.bounds import bench_bounds
from lalaloc_core.evaluate.bench.films import bench_films
from lalaloc_core.evaluate.bench.localisability_accuracy import bench_localisability
from lalaloc_core.evaluate.bench.service_latency import bench_service
from lalaloc_core.evaluate.bench.speed import bench_datasets, bench_methods, bench_rendering
from lalaloc_core.evaluate.bench.steps import bench_steps
from lalaloc_core.evaluate.bench.turns import bench_turns
from lalaloc_core.evaluate.bench.uninformative import bench_uninformative


def run_bench(
    bundle_folder: Path, groups: Sequence[str], *, homes: int, textures: Path | None, annotated: Path | None = None
) -> dict[str, Any]:
    """Measure groups of figures with one bundle.

    `homes` is the number of test homes, `textures` the folder of textures for the renderer, and `annotated` one of
    annotated photographs, for albums, bounds and films.
    """
    bundle = Bundle.open(bundle_folder)
    measure: Mapping[str, Callable[[], dict[str, Any]]] = {
        "rendering": lambda: bench_rendering(bundle),
        "service": lambda: bench_service(bundle, textures),
        "accuracy": lambda: bench_accuracy(bundle, homes, textures),
        "views": lambda: bench_views(bundle, homes, textures),
        "turns": lambda: bench_turns(bundle, homes, textures),
        "films": lambda: bench_films(bundle, homes, textures, annotated),
        "bounds": lambda: bench_bounds(bundle, homes, textures, annotated),
        "steps": lambda: bench_steps(bundle, homes, textures),
        "albums": lambda: bench_albums(bundle, homes, textures, annotated),
        "localisability": lambda: bench_localisability(bundle, homes, textures),
        "uninformative": lambda: bench_uninformative(bundle, homes, textures),
        "evidence": lambda: bench_evidence(bundle, homes, textures),
        "azimuths": lambda: bench_azimuths(bundle, homes, textures),
        "terms": lambda: bench_terms(bundle, homes, textures),
        "heights": lambda: bench_heights(bundle, homes, textures),
        "copies": lambda: bench_copies(bundle, homes, textures),
        "methods": lambda: bench_methods(bundle),
        "datasets": lambda: bench_datasets(bundle, textures),
    }
    machine = {"bundle": bundle.manifest.name, "version": bundle.manifest.version, "cores": os.cpu_count()}
    return machine | {group: measure[group]() for group in groups}
