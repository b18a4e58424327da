"""Aligning rendered layouts with an explicit one: gradient descent on the mean absolute difference of layout depths.

The refinement of the paper's baselines that predict a layout: HorizonNet + Loc (section 6.1) and VDR + Decode (section
6.1.2). It is latent pose optimisation with depth images in place of latents, on the same schedule.
"""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from lalaloc_core.localise.optimise import LpoConfig, PoseOptimiser
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.render.depth import layout_depth


class DepthAligner:
    """Moves poses, each within its own room, until the depth of their layouts is nearest to target images."""

    def __init__(self, *, rows: int, columns: int, thinning: int = 1, config: LpoConfig | None = None) -> None:
        """Choose the images that are compared.

        Args:
            rows: rows of the images.
            columns: columns of the wall profiles that are cast.
            thinning: the images have every n-th of these columns.
            config: margins and Adam's schedule.
        """

        def depth(
            profile_m: Float[Tensor, "k w"], camera_height_m: Float[Tensor, "k"], ceiling_height_m: Float[Tensor, "k"]
        ) -> Float[Tensor, "k d"]:
            return layout_depth(profile_m[:, ::thinning], camera_height_m, ceiling_height_m, rows).flatten(1)

        self._optimiser = PoseOptimiser(depth, columns, norm="l1", config=replace(config or LpoConfig(), method="adam"))

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Align every starting pose of a job whose targets are flattened depth images (m), rows first.

        Returns:
            the poses, with mean absolute differences of depth (m) as their distances.
        """
        return self._optimiser.refine(job)
