"""Alignment of a pose with an explicit layout by gradient descent on the mean absolute difference of layout depths.

It refines the paper's baselines HorizonNet + Loc (section 6.1) and VDR + Decode (section 6.1.2): LPO with depth images
in place of latents, on the same schedule.
"""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from lalaloc_core.localise.refine import LpoConfig
from lalaloc_core.localise.refine.latent_refiner import PoseOptimiser
from lalaloc_core.render.profile import layout_depth


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
