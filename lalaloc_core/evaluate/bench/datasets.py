"""How fast data sets are written, read and evaluated."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from lalaloc_core.evaluate.runs.predictions import RunFolder, RunInfo
from lalaloc_core.evaluate.runs.run import run_evaluation
from lalaloc_core.learn.data.structured3d import Structured3D
from lalaloc_core.learn.data.synthetic.writing import PICTURES_PER_ROOM, Synthesis, share_out, synthesise
from lalaloc_core.localise.bundle import Bundle

_SCENES = 48
_PANORAMA_HEIGHT = 256
_QUERIES = 300


def bench_datasets(bundle: Bundle, textures: Path | None) -> dict[str, Any]:
    """Write synthetic test scenes, read their annotations again and again, and localise 300 of their panoramas.

    Each takes a process per core.
    """
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as scratch:
        root = Path(scratch) / "scenes"
        settings = Synthesis(root=root, height=_PANORAMA_HEIGHT, textures=textures)
        begin = time.perf_counter()
        synthesise(settings, share_out(_SCENES, "test"), workers=cores)
        writing = time.perf_counter() - begin

        dataset = Structured3D(root)
        names = dataset.scenes("test")
        with ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
            # Every process reads once before it counts.
            list(pool.map(_count_cameras, [root] * 4 * cores, names[: 4 * cores]))
            begin = time.perf_counter()
            cameras = list(pool.map(_count_cameras, [root] * len(names), names, chunksize=2))
            reading = time.perf_counter() - begin

        info = RunInfo(
            label="all stages",
            method="lalaloc",
            kind="panorama",
            dataset=dataset.description,
            split="test",
            data=str(root),
            furniture="full",
            lighting="warm",
            limit=_QUERIES,
            bundle=str(bundle.folder),
        )
        begin = time.perf_counter()
        answered = len(run_evaluation(RunFolder(Path(scratch) / "run"), info))
        evaluating = time.perf_counter() - begin
    panoramas = PICTURES_PER_ROOM * sum(cameras)
    return {
        "panorama_height": _PANORAMA_HEIGHT,
        "scenes": len(names),
        "panoramas_written": panoramas,
        "panoramas_written_per_second": panoramas / writing,
        "scenes_read_per_second": len(names) / reading,
        "queries": answered,
        "evaluation_seconds": evaluating,
    }


def _count_cameras(root: Path, name: str) -> int:
    return len(Structured3D(root).load(name).cameras)
