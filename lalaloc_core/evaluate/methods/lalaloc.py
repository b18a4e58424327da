"""LaLaLoc as a method: retrieval, VDR and LPO, as in the service."""

from __future__ import annotations

import dataclasses
import math
import zlib
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from cachetools import LRUCache, cachedmethod
from jaxtyping import UInt8

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, TWO_PI
from lalaloc_core.evaluate.methods.method import GRIDS_CACHED, Answer, Pose, PredictedCandidate, Question, grid_key
from lalaloc_core.floorplan import DEFAULT_CAMERA_HEIGHT_M, FloorPlan
from lalaloc_core.learn.data.views import ViewPhotograph
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size
from lalaloc_core.localise.match import Layouts, MatchingConfig, MatchingCost, PoseGrid, layouts_at
from lalaloc_core.localise.query import DEFAULT_STD_M, CameraHeight, Candidate, PredictedProfile, Query
from lalaloc_core.localise.search.pipeline import LocaliseConfig, Refine, Refiner, StageClock, localise
from lalaloc_core.render.sampling import PoseSet

# Heading hypotheses of a layout query with unknown heading, for models without a ring.
_HEADINGS = 64
# Candidates per answer: enough to fit weights on wrong ones.
_CANDIDATES = 20
# Scale of the wall profile of a layout query, which is exact to single precision.
_TRUE_LAYOUT_LOG_SCALE = -7.0


@dataclass(frozen=True, kw_only=True)
class StatedHeight:
    """Camera height as stated to a method: with `error_m` added to the true one, and a standard deviation."""

    is_known: bool = True
    error_m: float = 0.0
    std_m: float = DEFAULT_STD_M

    def of(self, question: Question) -> CameraHeight:
        """Return the stated camera height of a question."""
        if not self.is_known:
            return CameraHeight(DEFAULT_CAMERA_HEIGHT_M, math.inf)
        return CameraHeight(max(question.camera.camera_height_m + self.error_m, MIN_CAMERA_HEIGHT_M), self.std_m)


class LaLaLoc:
    """Method with one bundle.

    As in the paper's table of times, embedding the grid of a plan and reading a photograph are not timed.
    """

    def __init__(
        self,
        encoders: PhotographEncoder,
        *,
        refine: Refine = "lpo",
        refiner: Refiner | None = None,
        config: LocaliseConfig | None = None,
        stated: StatedHeight = StatedHeight(),
        heading_error_deg: float = 0.0,
    ) -> None:
        self.encoders = encoders
        self._heading_error = math.radians(heading_error_deg)
        self._stated = stated
        self._refine: Refine = refine
        self._refiner = refiner
        # Evaluations report the pose after every stage.
        self._config = dataclasses.replace(config or LocaliseConfig(), every_stage=True)
        self._grids: LRUCache[Any, PoseGrid] = LRUCache(GRIDS_CACHED)

    def locate(self, question: Question) -> Answer:
        """Encode the query and run the service's search."""
        clock = StageClock()
        query = self._query(question, clock)
        grid = self.grid(question)
        found = localise(
            question.plan,
            grid,
            self.encoders.layouts,
            query,
            refine=self._refine,
            # The number of returned candidates does not change the search.
            top_k=_CANDIDATES,
            refiner=self._refiner,
            config=self._config,
        )
        # The confidence model is fitted on photographs and the default matching cost.
        calibrated = question.kind == "photograph" and self._config.matching == MatchingConfig()
        confidence = found.confidence(self.encoders.manifest.confidence_for(view=query.is_view)) if calibrated else None
        return Answer(
            stages={stage: found_pose(found.query, candidate) for stage, candidate in found.best.items()},
            candidates=tuple(
                PredictedCandidate(
                    pose=found_pose(found.query, candidate), terms=candidate.terms, probability=probability
                )
                for candidate, probability in zip(found.candidates, found.posterior.candidate, strict=True)
            ),
            retrieved=grid_index(grid, found.best["retrieval"]),
            signals={stage: dataclasses.asdict(values) for stage, values in found.signals.items()},
            information=found.best[found.stage].information,
            confidence=None if confidence is None else confidence.position,
            heading_confidence=None if confidence is None else confidence.heading,
            camera_height_m=found.camera_height_m,
            timings_ms={**clock.timings_ms, **found.timings_ms},
        )

    def _query(self, question: Question, clock: StageClock) -> Query:
        photograph, camera = question.photograph, question.camera
        if not isinstance(photograph, ViewPhotograph):
            image = read_image(self.encoders, question)
            with clock.stage("encode"):
                return encode(self.encoders, question, image, self._stated)
        view = photograph.open(patch_size(self.encoders.manifest))
        heading = None
        if question.heading_known:
            rng = np.random.default_rng(zlib.crc32(camera.position_m.tobytes()))
            heading = camera.heading + float(rng.uniform(-self._heading_error, self._heading_error))
        with clock.stage("encode"):
            return self.encoders.query(view, heading, self._stated.of(question), heading_tolerance=self._heading_error)

    @cachedmethod(attrgetter("_grids"), key=grid_key)
    def grid(self, question: Question) -> PoseGrid:
        """Return the pose grid of a question at its stated camera height; the last few are cached."""
        height_m, poses = self._stated.of(question).height_m, question.grid
        latents, profile_m = self.encoders.layouts.poses(question.plan, poses, np.zeros(len(poses)), height_m)
        return PoseGrid(poses, latents, profile_m, question.grid_step_m, height_m)


def read_image(encoders: PhotographEncoder, question: Question) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the photograph of the query at the encoder's size; None for layout queries."""
    if question.kind == "layout":
        return None
    return question.require_photograph().image(encoders.manifest.image_height, encoders.manifest.image_width)


def encode(
    encoders: PhotographEncoder,
    question: Question,
    image: UInt8[np.ndarray, "h w 3"] | None,
    stated: StatedHeight = StatedHeight(),
) -> Query:
    """Return the query of a question: the encoded photograph, or the true layout for layout queries."""
    camera = question.camera
    if image is not None:
        return encoders.spheres.query(image, camera.heading if question.heading_known else None, stated.of(question))
    rolls = np.array([camera.heading])
    if not question.heading_known:
        sectors = encoders.manifest.ring_sectors or _HEADINGS
        rolls = np.arange(sectors) * (TWO_PI / sectors)
    poses = PoseSet(np.repeat(camera.position_m[None], len(rolls), axis=0), np.full(len(rolls), camera.room_index))
    latents, profile_m = encoders.layouts.poses(question.plan, poses, camera.heading - rolls, camera.camera_height_m)
    profile = None
    if encoders.predicts_profile:
        profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, _TRUE_LAYOUT_LOG_SCALE))
    height = CameraHeight(camera.camera_height_m, 0.0)
    return Query(latents, rolls, 0.0, heading_known=question.heading_known, camera_height=height, profile=profile)


def found_pose(query: Query, candidate: Candidate) -> Pose:
    """Return a candidate as a pose of the sphere."""
    heading = photograph_heading(query, candidate)
    return Pose.at(candidate.position_m, candidate.room_index, heading, candidate.cost)


def cost_of_pose(query: Query, plan: FloorPlan, pose: Pose, weights: MatchingWeights) -> float:
    """Return the matching cost of a pose of the photograph."""
    assert query.profile is not None
    config = MatchingConfig()
    layouts = layouts_of_pose(query, plan, pose)
    cost, _ = MatchingCost(plan, query, config.fine_reach_m, weights, config).costs(layouts, np.array([0]))
    return float(cost[0, 0])


def layouts_of_pose(query: Query, plan: FloorPlan, pose: Pose) -> Layouts:
    """Return the layout at a pose in the frame of the query's first hypothesis."""
    assert query.profile is not None
    poses = PoseSet(pose.position_m[None], np.array([pose.room_index]))
    heading = np.array([math.radians(pose.heading_deg) - query.roll[0]])
    return layouts_at(plan, poses, heading, query.profile.log_m.shape[1])


def grid_index(grid: PoseGrid, candidate: Candidate) -> int:
    """Return the index of the grid pose of a retrieval candidate."""
    return int(np.linalg.norm(grid.poses.position_m - candidate.position_m, axis=1).argmin())
