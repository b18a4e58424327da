"""Speed of rendering, of LaLaLoc against ICP, of data sets, and of the stages and functions of a query."""

from __future__ import annotations

import cProfile
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
import torch

from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.methods.icp import Icp
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, local_refiner
from lalaloc_core.evaluate.methods.method import Method, Question
from lalaloc_core.evaluate.report.report_tables import markdown_table
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.predictions import RunFolder, RunInfo
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.data.structured3d import Structured3D
from lalaloc_core.learn.data.synthetic.generated import RenderedPhotograph, RendererCache
from lalaloc_core.learn.data.synthetic.writing import PICTURES_PER_ROOM, Synthesis, share_out, synthesise
from lalaloc_core.learn.synth.homes.plans import TEST, Home, home_of
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search.pipeline import StageClock, localise
from lalaloc_core.render.profile import layout_depth, wall_profile
from lalaloc_core.render.reference import reference_depth
from lalaloc_core.render.sampling import pose_grid, random_poses


def home_of_area(area_m2: float) -> Home:
    """Return the test home with the nearest area, among the first hundred."""
    homes = (home_of(TEST, 0, index)[0] for index in range(100))
    return min(homes, key=lambda home: abs(home.plan.area_m2 - area_m2))


def median_ms(call: Callable[[], object], repeats: int = 9) -> float:
    """Return the median duration (ms) of a call, after a warm-up."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append((time.perf_counter() - begin) * 1e3)
    return statistics.median(times)


_GRID_STEP_M = 0.5


def bench_rendering(setting: Setting) -> dict[str, float]:
    """Measure layout depth in closed form and by ray casting, and the pose grid of a 100 m² home."""
    poses, plan = 200, home_of_area(100.0).plan
    sampled = random_poses(plan, poses, np.random.default_rng(0))
    camera, ceiling = np.full(poses, 1.5), plan.ceiling_heights_m[sampled.room_index]
    arrays = (sampled.position_m, np.zeros(poses), plan.walls_m[sampled.room_index], camera, ceiling)
    position, heading, walls, cameras, ceilings = (torch.tensor(a, dtype=torch.float32) for a in arrays)

    def closed_form() -> None:
        layout_depth(wall_profile(position, heading, walls, 256), cameras, ceilings, 128)

    sample = range(0, poses, poses // 10)

    def oracle() -> None:
        for index in sample:
            room = plan.rooms[sampled.room_index[index]]
            reference_depth(room, sampled.position_m[index], 0.0, 1.5, 128, 256)

    encoders = PhotographEncoder(setting.bundle)
    closed_form_ms = median_ms(closed_form) / poses
    oracle_ms = median_ms(oracle, repeats=3) / len(sample)
    grid = build_grid(plan, encoders.layouts, step_m=_GRID_STEP_M, camera_height_m=1.5)
    return {
        "layout_depth_128x256_ms_per_pose": closed_form_ms,
        "oracle_128x256_ms_per_pose": oracle_ms,
        "oracle_to_closed_form_ratio": oracle_ms / closed_form_ms,
        "grid_area_m2": plan.area_m2,
        "grid_poses": len(grid.poses),
        "grid_seconds": median_ms(lambda: build_grid(plan, encoders.layouts, step_m=_GRID_STEP_M, camera_height_m=1.5))
        / 1e3,
    }


_METHOD_QUERIES = 5


def bench_methods(setting: Setting) -> dict[str, Any]:
    """Measure seconds per query of ICP and of LaLaLoc in a furnished home of 100 m², heading known, plan prepared."""
    home = home_of_area(100.0)
    shots = sample_shots(home, _METHOD_QUERIES + 1, np.random.default_rng(2), "full")
    # One height, so that all share one pose grid.
    shots = [replace(shot, camera_height_m=shots[0].camera_height_m) for shot in shots]
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(2)))
    grid = pose_grid(home.plan, _GRID_STEP_M)
    questions = [
        Question(
            plan=home.plan,
            grid=grid,
            grid_step_m=_GRID_STEP_M,
            camera=Camera(
                name="",
                position_m=shot.position_m,
                room_index=shot.room_index,
                heading=shot.heading,
                camera_height_m=shot.camera_height_m,
                photographs={},
            ),
            kind="photograph",
            photograph=RenderedPhotograph(shot, renderers),
        )
        for shot in shots
    ]
    encoders = PhotographEncoder(setting.bundle, threads=1)
    icp = _mean_seconds(Icp(), questions)
    lalaloc = _mean_seconds(LaLaLoc(encoders, refiner=local_refiner(setting.bundle)), questions)
    return {
        "area_m2": home.plan.area_m2,
        "grid_poses": len(grid),
        "queries": _METHOD_QUERIES,
        "icp_seconds": icp,
        "lalaloc_seconds": lalaloc,
        "icp_to_lalaloc_ratio": icp / lalaloc,
    }


def _mean_seconds(method: Method, questions: Sequence[Question]) -> float:
    """Return the mean time over all questions but the first, a warm-up."""
    answers = [method.locate(question) for question in questions]
    return float(np.mean([sum(answer.timings_ms.values()) for answer in answers[1:]])) / 1e3


_SCENES = 48
_SPHERE_HEIGHT = 256
_QUERIES = 300


def bench_datasets(setting: Setting) -> dict[str, Any]:
    """Measure writing synthetic test scenes, reading their annotations, and localising 300 spheres, on all cores."""
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as scratch:
        root = Path(scratch) / "scenes"
        settings = Synthesis(root=root, height=_SPHERE_HEIGHT, textures=setting.textures)
        begin = time.perf_counter()
        synthesise(settings, share_out(_SCENES, "test"), workers=cores)
        writing = time.perf_counter() - begin

        dataset = Structured3D(root)
        names = dataset.scenes("test")
        with ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
            # Warm-up of every process.
            list(pool.map(_count_cameras, [root] * 4 * cores, names[: 4 * cores]))
            begin = time.perf_counter()
            cameras = list(pool.map(_count_cameras, [root] * len(names), names, chunksize=2))
            reading = time.perf_counter() - begin

        info = RunInfo(
            label="all stages",
            dataset=dataset.description,
            split="test",
            data=str(root),
            furniture="full",
            lighting="warm",
            limit=_QUERIES,
            bundle=str(setting.bundle.folder),
        )
        begin = time.perf_counter()
        answered = len(run_evaluation(RunFolder(Path(scratch) / "run"), info))
        evaluating = time.perf_counter() - begin
    spheres = PICTURES_PER_ROOM * sum(cameras)
    return {
        "sphere_height": _SPHERE_HEIGHT,
        "scenes": len(names),
        "spheres_written": spheres,
        "spheres_written_per_second": spheres / writing,
        "scenes_read_per_second": len(names) / reading,
        "queries": answered,
        "evaluation_seconds": evaluating,
    }


def _count_cameras(root: Path, name: str) -> int:
    return len(Structured3D(root).load(name).cameras)


_FUNCTIONS = 20
_STAGES = ("encode", "retrieve", "vdr", "lpo")


def profile_table(bundle: Bundle, queries: int, textures: Path | None) -> str:
    """Return tables of the stages, and by the profiler of the slowest functions, of queries in one thread."""
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

    for known in (True, False):
        time_query(0, known=known)
    timings = {known: [time_query(index, known=known) for index in range(queries)] for known in (True, False)}
    rows = [
        (stage, *(f"{statistics.median(query[stage] for query in timings[known]):.1f} ms" for known in (True, False)))
        for stage in _STAGES
    ]
    tables = [markdown_table((f"stage, median of {queries} queries", "known heading", "unknown heading"), rows)]
    for known in (True, False):
        profiler = cProfile.Profile()
        profiler.enable()
        for index in range(queries):
            time_query(index, known=known)
        profiler.disable()
        slowest = sorted(profiler.getstats(), key=lambda entry: -entry.inlinetime)[:_FUNCTIONS]
        rows = [
            (_name(entry.code), f"{entry.callcount / queries:.0f}", f"{1e3 * entry.inlinetime / queries:.2f}")
            for entry in slowest
        ]
        title = f"function, {'known' if known else 'unknown'} heading"
        tables.append(markdown_table((title, "calls per query", "own ms per query"), rows))
    return "\n".join(tables)


def _name(code: CodeType | str) -> str:
    """Return file and name of a function, or the profiler's description of a built-in one."""
    return f"`{code}`" if isinstance(code, str) else f"`{Path(code.co_filename).name}` {code.co_qualname}"
