"""The paper's baselines with explicit layouts: "HorizonNet + Loc" (section 6.1), and VDR with decoded layouts.

The image encoder's wall profile takes the place of HorizonNet's. All stages compare the mean absolute difference of
layout depths: retrieval on the grid, VDR on a Vogel disc, then gradient descent. A wall profile has no ceiling, so the
prediction takes the ceiling of the room that it is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods.lalaloc import LaLaLoc, encode, found_pose, grid_index, read_image
from lalaloc_core.evaluate.methods.method import GRIDS_CACHED, Answer, Pose, Question, grid_key
from lalaloc_core.evaluate.methods.similarity import layouts_at
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.refine import LpoConfig, RefinementJob
from lalaloc_core.localise.refine.latent_refiner import PoseOptimiser
from lalaloc_core.localise.refine.refinement import refinement_job
from lalaloc_core.localise.search.pipeline import LocaliseConfig, StageClock, localise
from lalaloc_core.localise.search.retrieval import disc_poses
from lalaloc_core.nets.layout_network import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder
from lalaloc_core.render.profile import layout_depth
from lalaloc_core.render.sampling import PoseSet


def depth_aligner(*, rows: int, columns: int, thinning: int = 1, config: LpoConfig | None = None) -> PoseOptimiser:
    """Return an optimiser that moves poses within their rooms until their layout depths match target images.

    The targets of its jobs are flattened depth images (m), rows first; its costs are mean absolute differences (m).
    `columns` are those of the rendered wall profiles, of which the images keep every `thinning`-th. `config` has the
    margins and Adam's schedule.
    """

    def depth(
        profile_m: Float[Tensor, "k w"], camera_height_m: Float[Tensor, "k"], ceiling_height_m: Float[Tensor, "k"]
    ) -> Float[Tensor, "k d"]:
        return layout_depth(profile_m[:, ::thinning], camera_height_m, ceiling_height_m, rows).flatten(1)

    return PoseOptimiser(depth, columns, norm="l1", config=replace(config or LpoConfig(), method="adam"))


_ROWS = 32


class ExplicitLayout:
    """Method with the wall profile that a `ring` bundle predicts; layout queries use the true one."""

    def __init__(self, encoders: PhotographEncoder) -> None:
        self._encoders = encoders
        self._config = LocaliseConfig()
        self._columns = encoders.manifest.profile_columns
        self._aligner = depth_aligner(rows=_ROWS, columns=self._columns)
        self._grids: LRUCache[Any, _RenderedPoses] = LRUCache(GRIDS_CACHED)

    def locate(self, question: Question) -> Answer:
        """Predict the layout, retrieve, re-sample and align."""
        if not question.heading_known:
            raise InvalidInputError("method 'explicit' needs the heading; run it with a known heading")
        plan, clock = question.plan, StageClock()
        grid = self._grid(question)
        image = read_image(self._encoders, question)
        with clock.stage("encode"):
            # With the heading of the layouts to compare with it.
            if image is None:
                profile_m, heading = question.true_profile(self._columns), 0.0
            else:
                camera = question.camera
                profile_m, heading = self._encoders.spheres.profile(image, camera.heading, camera.camera_height_m)
        with clock.stage("retrieve"):
            retrieved, distance = grid.nearest(profile_m)
        stages = {"retrieval": question.pose_of(question.grid, retrieved, distance)}
        with clock.stage("vdr"):
            config = self._config
            radius_m = config.vdr_radius_steps * question.grid_step_m
            centre = question.grid.position_m[retrieved]
            disc, _ = disc_poses(plan, centre, samples=config.vdr_samples, radius_m=radius_m)
            # The disc contains its centre, so its nearest pose is at least as near as the retrieved one.
            nearest, distance = self._rendered(question, disc, heading).nearest(profile_m)
            stages["vdr"] = question.pose_of(disc, nearest, distance)
        with clock.stage("align"):
            stages["align"] = self._align(question, profile_m, heading, stages["vdr"])
        return Answer(stages=stages, retrieved=retrieved, timings_ms=clock.timings_ms)

    @cachedmethod(attrgetter("_grids"), key=grid_key)
    def _grid(self, question: Question) -> _RenderedPoses:
        return self._rendered(question, question.grid, heading=0.0)

    def _rendered(self, question: Question, poses: PoseSet, heading: float) -> _RenderedPoses:
        profile, camera, ceiling = layouts_at(
            question.plan, poses, question.camera.camera_height_m, self._columns, heading
        )
        depth = layout_depth(profile, camera, ceiling, _ROWS).astype(np.float32)
        return _RenderedPoses(depth, question.camera.camera_height_m, ceiling)

    def _align(self, question: Question, profile_m: Float[np.ndarray, "w"], heading: float, start: Pose) -> Pose:
        room = np.array([start.room_index])
        camera, ceiling = np.array([question.camera.camera_height_m]), question.plan.ceiling_heights_m[room]
        job = RefinementJob(
            targets=layout_depth(profile_m[None], camera, ceiling, _ROWS).reshape(1, -1),
            position_m=start.position_m[None],
            heading=np.array([heading]),
            walls_m=question.plan.walls_m[room],
            camera_height_m=camera,
            ceiling_height_m=ceiling,
            optimise_heading=False,
        )
        aligned = self._aligner.refine(job)
        return Pose.at(aligned.position_m[0], start.room_index, question.camera.heading, float(aligned.cost[0]))


@dataclass(frozen=True, eq=False)
class _RenderedPoses:
    """Layout depths (m) of poses at one camera height, with the ceiling height of each."""

    depth_m: Float[np.ndarray, "n h w"]
    camera_height_m: float
    ceiling_height_m: Float[np.ndarray, "n"]

    def nearest(self, profile_m: Float[np.ndarray, "w"]) -> tuple[int, float]:
        """Return the index of the pose with the nearest depth to that of a wall profile, and the distance (m)."""
        distance = np.empty(len(self.depth_m))
        camera = np.array([self.camera_height_m])
        for ceiling in np.unique(self.ceiling_height_m):
            below = self.ceiling_height_m == ceiling
            depth = layout_depth(profile_m[None], camera, np.array([ceiling]), self.depth_m.shape[1])
            distance[below] = np.abs(self.depth_m[below] - depth.astype(np.float32)).mean(axis=(1, 2))
        index = int(distance.argmin())
        return index, float(distance[index])


class VdrDecode:
    """Method with a bundle and the decoder that its layout encoder was trained with."""

    def __init__(self, encoders: PhotographEncoder, decoder: LayoutDecoder) -> None:
        self._lalaloc = LaLaLoc(encoders, refine="vdr")
        # The paper compares latents only.
        self._config = LocaliseConfig(matching=MatchingConfig(use_profile=False))
        self._decoder = decoder.eval().requires_grad_(False)
        # Training shows the decoder every n-th column of the encoder's wall profile.
        columns = encoders.manifest.profile_columns
        thinning = max(columns // DECODED_WIDTH, 1)
        self._width = len(range(0, columns, thinning))
        self._aligner = depth_aligner(rows=DECODED_HEIGHT, columns=columns, thinning=thinning)

    def locate(self, question: Question) -> Answer:
        """Retrieve, re-sample with VDR, decode the query's latent and align."""
        encoders, plan, clock = self._lalaloc.encoders, question.plan, StageClock()
        image = read_image(encoders, question)
        with clock.stage("encode"):
            query = encode(encoders, question, image)
        grid = self._lalaloc.grid(question)
        found = localise(plan, grid, encoders.layouts, query, refine="vdr", config=self._config)
        clock.timings_ms.update(found.timings_ms)
        with clock.stage("decode"):
            start = found.candidates[0]
            job = refinement_job(
                plan,
                query,
                [start],
                grid.camera_height_m,
                encoders.manifest.evidence_for(view=query.is_view),
                self._config.matching,
            )
            result = self._aligner.refine(replace(job, targets=self.decode(job.targets)))
        aligned = replace(
            start,
            x_m=float(result.position_m[0, 0]),
            y_m=float(result.position_m[0, 1]),
            frame_heading=float(result.heading[0]),
            cost=float(result.cost[0]),
        )
        best = {**found.best, "decode": aligned}
        return Answer(
            stages={stage: found_pose(query, candidate) for stage, candidate in best.items()},
            retrieved=grid_index(grid, best["retrieval"]),
            timings_ms=clock.timings_ms,
        )

    def decode(self, latents: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k pixels"]:
        """Return flattened layout depths (m) of latents, as wide as the layouts to compare."""
        with torch.no_grad():
            depth = self._decoder(torch.from_numpy(np.asarray(latents, dtype=np.float32)))
            # Training compares at the width of the profile where that is narrower than the decoder's images.
            narrowed = functional.interpolate(depth[:, None], (DECODED_HEIGHT, self._width))
        return narrowed.flatten(1).numpy()
