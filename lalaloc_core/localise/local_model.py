"""Model on one thread of this process, without a service: photographs, pose grids and searches."""

from __future__ import annotations

from collections.abc import Sequence

from lalaloc_core.bundle import Bundle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size, sphere_size
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult, refine_walls, refined_by_walls
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, Refiner, localise
from lalaloc_core.localise.sequence.joint_refinement import refine_sequence
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation, localise_sequence
from lalaloc_core.localise.sequence.turn_localisation import LinkedTurn, found_turns, judged_turn, localised_turn
from lalaloc_core.photograph import Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.turn_angles import TurnAngles
from lalaloc_core.photograph.turned import open_turn

# Step of the grids of `LocalModel`.
GRID_STEP_M = 0.5


class LocalModel:
    """Model that localises photographs in this process, on one thread."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.encoder = PhotographEncoder(bundle, threads=1)
        self.refiner: Refiner = _LocalRefiner(bundle).refine

    def grid(self, plan: FloorPlan, camera_height_m: float, step_m: float = GRID_STEP_M) -> PoseGrid:
        """Compute the pose grid of a plan, with latents if the model compares only these."""
        latents = not self.encoder.predicts_profile
        return build_grid(plan, self.encoder, step_m=step_m, camera_height_m=camera_height_m, latents=latents)

    def open(self, content: bytes, stated: StatedCamera | None = None) -> Photograph:
        """Read a photograph in the sizes that the model needs.

        Raises:
            InvalidPhotographError: the photograph cannot be read.
        """
        manifest = self.bundle.manifest
        return open_photograph(
            content, sphere_size=sphere_size(manifest), stated=stated, patch_size=patch_size(manifest)
        )

    def localise(self, plan: FloorPlan, grid: PoseGrid, query: Query) -> Localisation:
        """Search a plan."""
        return localise(plan, grid, self.encoder, query, refiner=self.refiner)

    def open_turn(
        self, contents: Sequence[bytes], stated: StatedCamera | None = None
    ) -> tuple[list[Photograph], list[TurnAngles]]:
        """Read photographs of one spot, in the order in which they were taken, with the angles that overlap tells."""
        manifest = self.bundle.manifest
        return open_turn(
            contents, stated or StatedCamera(), sphere_size=sphere_size(manifest), patch_size=patch_size(manifest)
        )

    def localise_turn(
        self,
        plan: FloorPlan,
        grid: PoseGrid,
        photographs: Sequence[Photograph],
        linked: LinkedTurn,
        height: CameraHeight,
    ) -> SequenceLocalisation:
        """Search the place of photographs of one spot, and the angles that are not known."""

        def as_one(turns: Sequence[float]) -> Localisation:
            others = list(zip(photographs[1:], turns[1:], strict=True))
            query = self.encoder.query(photographs[0], None, height, others=others)
            config = LocaliseConfig(vdr_candidates=0)
            return localise(plan, grid, self.encoder, query, refiner=self.refiner, config=config)

        if linked.turns is not None:
            return localised_turn(as_one(linked.turns), linked.turns)
        queries = [self.encoder.query(photographs[index], None, height) for index in linked.order]
        found = localise_sequence(plan, grid, self.encoder, queries, linked.motions, refiner=refine_sequence)
        found = linked.in_order(found)
        return judged_turn(found, as_one(found_turns(found)))


class _LocalRefiner:
    """Refiner in this process; torch is loaded when the first job compares latents."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self._by_latents: Refiner | None = None

    def refine(self, job: RefinementJob) -> RefinementResult | None:
        """Refine the poses of a job within their rooms."""
        if refined_by_walls(job):
            return refine_walls(job)
        if self._by_latents is None:
            import torch

            from lalaloc_core.localise.refine.latent_refiner import PoseRefiner

            # Its tensors are too small to share between threads.
            torch.set_num_threads(1)
            self._by_latents = PoseRefiner.from_bundle(self._bundle).refine
        return self._by_latents(job)
