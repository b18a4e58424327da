"""Speed of rendering, of LaLaLoc against ICP, and of data sets."""

from __future__ import annotations

import os
import statistics
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from lalaloc_core.evaluate.bench.measured import Setting, evaluate, timed
from lalaloc_core.evaluate.methods.icp import Icp
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, local_refiner
from lalaloc_core.evaluate.methods.method import Method, Question
from lalaloc_core.evaluate.runs.evaluation import question_of
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.learn.data.structured3d import Structured3D
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, RendererCache
from lalaloc_core.learn.data.synthetic.writing import PICTURES_PER_ROOM, Synthesis, share_out, synthesise
from lalaloc_core.learn.synth.homes.plans import TEST, Home, home_of
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.local_model import GRID_STEP_M, LocalModel
from lalaloc_core.render.profile import layout_depth, wall_profile
from lalaloc_core.render.reference import reference_depth
from lalaloc_core.render.sampling import pose_grid, random_poses


def home_of_area(area_m2: float) -> Home:
    """Return the test home with the nearest area, among the first hundred."""
    homes = (home_of(TEST, 0, index)[0] for index in range(100))
    return min(homes, key=lambda home: abs(home.plan.area_m2 - area_m2))


def spheres_of_home(
    count: int, size: tuple[int, int], textures: Path | None = None
) -> tuple[list[Shot], UInt8[np.ndarray, "n h w 3"]]:
    """Return shots of a furnished test home of about 100 m², and their spheres of a size (height, width)."""
    shots = sample_shots(home_of_area(100.0), count, np.random.default_rng(1), "full")
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(1), textures))
    return shots, renderers.renderer(*size).render(shots).cpu().numpy()


def median_ms(call: Callable[[], object], repeats: int = 9) -> float:
    """Return the median duration (ms) of a call, after a warm-up."""
    call()
    return 1e3 * statistics.median(timed(call)[0] for _ in range(repeats))


def bench_rendering(setting: Setting) -> dict[str, float]:
    """Measure layout depth in closed form and by ray casting, and the pose grid of a 100 m² home."""
    poses, plan = 200, home_of_area(100.0).plan
    sampled = random_poses(plan, poses, np.random.default_rng(0))
    camera, ceiling = np.full(poses, 1.5), plan.ceiling_heights_m[sampled.room_index]
    arrays = (sampled.position_m, np.zeros(poses), plan.walls_m[sampled.room_index], camera, ceiling)
    position, heading, walls, cameras, ceilings = (torch.tensor(a, dtype=torch.float32) for a in arrays)
    sample = range(0, poses, poses // 10)
    model = LocalModel(setting.bundle)

    def closed_form() -> None:
        layout_depth(wall_profile(position, heading, walls, 256), cameras, ceilings, 128)

    def oracle() -> None:
        for index in sample:
            room = plan.rooms[sampled.room_index[index]]
            reference_depth(room, sampled.position_m[index], 0.0, 1.5, 128, 256)

    closed_form_ms = median_ms(closed_form) / poses
    oracle_ms = median_ms(oracle, repeats=3) / len(sample)
    return {
        "layout_depth_128x256_ms_per_pose": closed_form_ms,
        "oracle_128x256_ms_per_pose": oracle_ms,
        "oracle_to_closed_form_ratio": oracle_ms / closed_form_ms,
        "grid_area_m2": plan.area_m2,
        "grid_poses": len(pose_grid(plan, GRID_STEP_M)),
        "grid_seconds": median_ms(lambda: model.grid(plan, 1.5)) / 1e3,
    }


_METHOD_QUERIES = 5


def bench_methods(setting: Setting) -> dict[str, Any]:
    """Measure seconds per query of ICP and of LaLaLoc in a furnished home of 100 m², heading known, plan prepared."""
    area_m2 = home_of_area(100.0).plan.area_m2
    scenes = GeneratedScenes(homes=100, shots_per_home=_METHOD_QUERIES + 1)
    scene = next(scene for scene in map(scenes.load, scenes.scenes("test")) if scene.plan.area_m2 == area_m2)
    info = RunInfo(label="speed", dataset=scenes.description, split="test", furniture="full")
    grid = pose_grid(scene.plan, info.grid_step_m)
    questions = [question_of(scene, camera, info, grid) for camera in scene.cameras]
    encoders = PhotographEncoder(setting.bundle, threads=1)
    icp = _mean_seconds(Icp(), questions)
    lalaloc = _mean_seconds(LaLaLoc(encoders, refiner=local_refiner(setting.bundle)), questions)
    return {
        "area_m2": area_m2,
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
    """Measure writing synthetic test scenes on all cores, reading them on one, and localising 300 spheres on all."""
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as scratch:
        root = Path(scratch) / "scenes"
        settings = Synthesis(root=root, height=_SPHERE_HEIGHT, textures=setting.textures)
        writing_s, _ = timed(lambda: synthesise(settings, share_out(_SCENES, "test"), workers=os.cpu_count() or 1))
        dataset = Structured3D(root)
        names = dataset.scenes("test")
        reading_s, scenes = timed(lambda: list(map(dataset.load, names)))
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
        evaluating_s, answers = timed(evaluate, info)
    spheres = PICTURES_PER_ROOM * sum(len(scene.cameras) for scene in scenes)
    return {
        "sphere_height": _SPHERE_HEIGHT,
        "scenes": len(names),
        "spheres_written": spheres,
        "spheres_written_per_second": spheres / writing_s,
        "scenes_read_per_second": len(names) / reading_s,
        "queries": len(answers),
        "evaluation_seconds": evaluating_s,
    }
