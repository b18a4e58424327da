"""ICP and LaLaLoc on the same queries of one home, one thread each (paper, table of times)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lalaloc_core.evaluate.bench.homes import home_of_area
from lalaloc_core.evaluate.methods.icp import Icp
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, local_refiner
from lalaloc_core.evaluate.methods.method import Method, Question
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.data.synthetic.generated import RenderedPhotograph, RendererCache
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.render.sampling import pose_grid

_QUERIES = 5
_GRID_STEP_M = 0.5


def bench_methods(bundle: Bundle) -> dict[str, Any]:
    """Seconds per query of ICP and of LaLaLoc, in the home nearest 100 m², furnished, heading known.

    What belongs to the plan (ICP's cloud of the walls, LaLaLoc's latent grid) is made before and not counted.
    """
    home = home_of_area(100.0)
    shots = sample_shots(home, _QUERIES + 1, np.random.default_rng(2), "full")
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(2)))
    grid = pose_grid(home.plan, _GRID_STEP_M)
    questions = [
        Question(
            plan=home.plan,
            grid=grid,
            grid_step_m=_GRID_STEP_M,
            camera=Camera(
                name=str(index),
                position_m=shot.position_m,
                room_index=shot.room_index,
                heading=shot.heading,
                # One height, so that one latent grid serves all.
                camera_height_m=shots[0].camera_height_m,
                photographs={},
            ),
            kind="panorama",
            photograph=RenderedPhotograph(replace(shot, camera_height_m=shots[0].camera_height_m), renderers),
        )
        for index, shot in enumerate(shots)
    ]
    icp = _mean_seconds(Icp(), questions)
    lalaloc = _mean_seconds(LaLaLoc(Encoders(bundle, threads=1), refiner=local_refiner(bundle)), questions)
    return {
        "area_m2": home.plan.area_m2,
        "grid_poses": len(grid),
        "queries": _QUERIES,
        "icp_seconds": icp,
        "lalaloc_seconds": lalaloc,
        "icp_to_lalaloc_ratio": icp / lalaloc,
    }


def _mean_seconds(method: Method, questions: Sequence[Question]) -> float:
    """Mean over all questions but the first, which warms up."""
    answers = [method.answer(question) for question in questions]
    return float(np.mean([sum(answer.timings_ms.values()) for answer in answers[1:]])) / 1e3
