"""Program of an LPO worker process, the only part of the service that imports torch.

It turns a `RefinementJob` into a `RefinementResult`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lalaloc_core.bundle import Bundle, Manifest
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from service.workers.process import serve_jobs

if TYPE_CHECKING:
    from lalaloc_core.localise.refine.latent_refiner import PoseRefiner


def run_worker(connection: Connection, bundle_folder: str, model_sha256: str, threads: int, by_latents: bool) -> None:
    """Load the refiner, see `load_refiner`, then run jobs until the pipe closes."""
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = str(threads)
    serve_jobs(connection, lambda: load_refiner(Path(bundle_folder), model_sha256, threads, by_latents=by_latents))


def load_refiner(
    bundle_folder: Path, model_sha256: str, threads: int, *, by_latents: bool = True
) -> Callable[[RefinementJob], RefinementResult]:
    """Return the function from job to result.

    If the model's poses are refined `by_latents`, torch is loaded and warmed up now, with some `threads`; else with the
    first job that needs it: poses refined by walls need none, and torch takes a quarter of a gigabyte.
    """
    bundle = Bundle.open(bundle_folder)
    if bundle.sha256 != model_sha256:
        raise RuntimeError(f"the bundle in {bundle_folder} changed to {bundle.sha256}: restart the service")

    @cache
    def refiner() -> PoseRefiner:
        import torch

        from lalaloc_core.localise.refine.latent_refiner import PoseRefiner

        torch.set_num_threads(threads)
        loaded = PoseRefiner.from_bundle(bundle)
        for optimise_heading, by_profile in product((False, True), repeat=2):
            loaded.refine(warm_up_job(bundle.manifest, optimise_heading=optimise_heading, by_profile=by_profile))
        return loaded

    if by_latents:
        refiner()

    return lambda job: refiner().refine(job)


def warm_up_job(manifest: Manifest, *, optimise_heading: bool, by_profile: bool) -> RefinementJob:
    """Return a small job that triggers everything that is built on first use."""
    plan = FloorPlan.from_dict(
        {"ceiling_height_m": 2.5, "rooms": [{"polygon": [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]}]}
    )
    target = np.ones((2, manifest.latent_size), np.float32) / np.sqrt(np.float32(manifest.latent_size))
    profile = np.zeros((2, manifest.profile_columns), np.float32)
    return RefinementJob(
        targets=target,
        position_m=np.array([[1.0, 1.0], [2.5, 2.0]]),
        heading=np.zeros(2),
        walls_m=plan.walls_m[[0, 0]],
        camera_height_m=np.full(2, plan.camera_height_m),
        ceiling_height_m=plan.ceiling_heights_m[[0, 0]],
        optimise_heading=optimise_heading,
        log_profile=profile if by_profile else None,
        precision=np.ones_like(profile) if by_profile else None,
    )
