"""Model on one thread of this process, without a service: photographs, pose grids and searches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.answers.documents import Ground
from lalaloc_core.localise.answers.turns import Turn
from lalaloc_core.localise.encode.features import is_features, read_features
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size, sphere_size
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.localise.refine import RefinementJob, RefinementResult, refine_walls, refined_by_walls
from lalaloc_core.localise.search.pipeline import Localisation, Refiner, localise, run_steps
from lalaloc_core.localise.search.turn_search import TurnLocalisation
from lalaloc_core.photograph import Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.photograph import Purpose
from lalaloc_core.photograph.turn_angles import TurnAngles
from lalaloc_core.photograph.turned import open_turn

# Step of the grids of `LocalModel`.
GRID_STEP_M = 0.5


class LocalModel:
    """Model that localises photographs in this process, on one thread."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.encoder = PhotographEncoder(bundle, threads=1)
        manifest = bundle.manifest
        self._sizes: dict[str, Any] = {"sphere_size": sphere_size(manifest), "patch_size": patch_size(manifest)}

    def grid(self, plan: FloorPlan, camera_height_m: float, step_m: float = GRID_STEP_M) -> PoseGrid:
        """Compute the pose grid of a plan, with latents if the model compares only these."""
        latents = not self.encoder.predicts_profile
        return build_grid(plan, self.encoder.layouts, step_m=step_m, camera_height_m=camera_height_m, latents=latents)

    def open(self, content: bytes, stated: StatedCamera | None = None, *, purpose: Purpose = "single") -> Photograph:
        """Read a photograph in the sizes that the model needs; `purpose` is as for `open_photograph`.

        Raises:
            InvalidPhotographError: the photograph cannot be read.
        """
        return open_photograph(content, stated=stated, purpose=purpose, **self._sizes)

    def open_any(self, content: bytes, stated: StatedCamera) -> Photograph:
        """Read a photograph, or the one whose features a file has."""
        if not is_features(content):
            return self.open(content, stated)
        if stated != StatedCamera():
            raise InvalidPhotographError("the camera is stated to `lalaloc encode`; leave its options out")
        return read_features(content, self.bundle)

    def open_turn(
        self, contents: Sequence[bytes], stated: StatedCamera | None = None
    ) -> tuple[list[Photograph], list[TurnAngles]]:
        """Read photographs of one spot, in the order in which they were taken, with the angles that overlap tells."""
        return open_turn(contents, stated or StatedCamera(), **self._sizes)

    def localise(self, plan: FloorPlan, grid: PoseGrid, query: Query) -> Localisation:
        """Search a plan."""
        return localise(plan, grid, self.encoder.layouts, query, refiner=self.refiner)

    def localise_turn(
        self,
        plan: FloorPlan,
        grid: PoseGrid,
        photographs: Sequence[Photograph],
        angles: Sequence[TurnAngles],
        height: CameraHeight,
    ) -> TurnLocalisation:
        """Search the place of photographs of one spot, and the angles that are not known."""
        known = [UNKNOWN_HEADING] * len(photographs)
        return self.search_turn(Turn.of_overlap(photographs, known, height, angles), Ground(plan, grid))

    def search_turn(self, turn: Turn, ground: Ground) -> TurnLocalisation:
        """Search the place of a turn."""
        queries = [turn.query(self.encoder, *spot) for spot in turn.spots]
        return run_steps(turn.steps(ground, self.encoder, queries), self.refiner)

    def refiner(self, job: RefinementJob) -> RefinementResult | None:
        """Refine the poses of a job within their rooms."""
        return refine_walls(job) if refined_by_walls(job) else self._by_latents(job)

    @cached_property
    def _by_latents(self) -> Refiner:
        """Refiner by latents; torch is loaded when the first job compares them."""
        import torch

        from lalaloc_core.localise.refine.latent_refiner import PoseRefiner

        # Its tensors are too small to share between threads.
        torch.set_num_threads(1)
        return PoseRefiner.from_bundle(self.bundle).refine
