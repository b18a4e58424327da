"""How fast data sets are written, read and evaluated."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.data.dataset import load_scenes
from lalaloc_core.data.structured3d import Structured3D
from lalaloc_core.data.synthesise import PICTURES_PER_ROOM, Synthesis, share_out, synthesise
from lalaloc_core.evaluation.predictions import RunFolder, RunInfo
from lalaloc_core.evaluation.run import run_evaluation

_SCENES = 48
_PANORAMA_HEIGHT = 256
_QUERIES = 300


def bench_datasets(bundle: Bundle, textures: Path | None) -> dict[str, Any]:
    """Write synthetic test scenes, read their annotations again and again, and localise 300 of their panoramas.

    Writing and localising take a process per core, reading one.
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
        begin = time.perf_counter()
        rooms = [len(scene.cameras) for scene in load_scenes(dataset, names)]
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
    panoramas = PICTURES_PER_ROOM * sum(rooms)
    return {
        "panorama_height": _PANORAMA_HEIGHT,
        "scenes": len(names),
        "panoramas_written": panoramas,
        "panoramas_written_per_second": panoramas / writing,
        "scenes_read_per_second": len(names) / reading,
        "queries": answered,
        "evaluation_seconds": evaluating,
    }
