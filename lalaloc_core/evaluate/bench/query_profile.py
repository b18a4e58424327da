"""Profile of a query: the production path in this process under cProfile."""

from __future__ import annotations

import cProfile
import statistics
from pathlib import Path
from types import CodeType

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.bench.speed import home_of_area
from lalaloc_core.learn.data.synthetic.generated import RendererCache
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import StageClock, localise

_FUNCTIONS = 20
_STAGES = ("encode", "retrieve", "vdr", "lpo")


def profile_table(bundle: Bundle, queries: int, textures: Path | None) -> str:
    """Return tables of the stages and of the slowest functions of queries in a home of 100 m², in one thread.

    Stages are timed without the profiler, as medians over the queries; functions with it, by their own time.
    """
    home = home_of_area(100.0)
    shots = sample_shots(home, queries, np.random.default_rng(1), "full")
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(1), textures))
    model = LocalModel(bundle)
    height, width = bundle.manifest.image_height, bundle.manifest.image_width
    images = renderers.renderer(height, width).render(shots).cpu().numpy()
    grid = model.grid(home.plan, home.plan.camera_height_m)

    def time_query(index: int, *, known: bool) -> dict[str, float]:
        clock, shot = StageClock(), shots[index]
        with clock.stage("encode"):
            heading = shot.heading if known else None
            query = model.encoder.spheres.query(images[index], heading, CameraHeight(shot.camera_height_m))
        localise(home.plan, grid, model.encoder.layouts, query, refiner=model.refiner, clock=clock)
        return clock.timings_ms

    lines = [f"| stage, median of {queries} queries | known heading | unknown heading |", "|---|---|---|"]
    for known in (True, False):
        time_query(0, known=known)
    timings = {known: [time_query(index, known=known) for index in range(queries)] for known in (True, False)}
    for stage in _STAGES:
        medians = [statistics.median(timing[stage] for timing in timings[known]) for known in (True, False)]
        lines.append(f"| {stage} | {medians[0]:.1f} ms | {medians[1]:.1f} ms |")
    for known in (True, False):
        profiler = cProfile.Profile()
        profiler.enable()
        for index in range(queries):
            time_query(index, known=known)
        profiler.disable()
        title = "known" if known else "unknown"
        lines += ["", f"| function, {title} heading | calls per query | own ms per query |", "|---|---|---|"]
        lines += _slowest(profiler, queries)
    return "\n".join(lines)


def _slowest(profiler: cProfile.Profile, queries: int) -> list[str]:
    """Return rows of the functions with the most time of their own."""
    ranked = sorted(profiler.getstats(), key=lambda entry: -entry.inlinetime)[:_FUNCTIONS]
    return [
        f"| {_name(entry.code)} | {entry.callcount / queries:.0f} | {1e3 * entry.inlinetime / queries:.2f} |"
        for entry in ranked
    ]


def _name(code: CodeType | str) -> str:
    """Return file and name of a function, or the profiler's description of a built-in one."""
    return f"`{code}`" if isinstance(code, str) else f"`{Path(code.co_filename).name}` {code.co_qualname}"
