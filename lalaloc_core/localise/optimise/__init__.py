"""Pose refinement (LPO; paper, section 4.2.1): move a pose until its layout fits the predictions.

In the paper `min over pose of | Φ_layout(Ω(pose, plan)) - f |₂`, on latents, with the renderer Ω. If the model predicts
a wall profile with its uncertainty, the layout's profile is compared with that, by the walls' term of the matching cost
(`localise.matching_cost`). Two optimisers share one evaluation (residuals and their derivatives by 2 or 3 unknowns; the
log of true over stated camera height is one more if profiles are compared):

* Levenberg-Marquardt (default): under 15 evaluations, and more exact.
* Adam with the paper's schedule (section A.3): the reference.

Several starting poses are refined as one batch; every pose stays inside the room it started in. The derivatives of the
renderer are in closed form (`render.gradient`); those of the embedding, usually a network, are taken by forward-mode
differentiation. `PoseOptimiser` accepts any differentiable function of a layout; a baseline of the paper compares the
layouts themselves.

Begin with `optimiser.py`; `localise.descent` has the evaluation, the two optimisers, and refinement by walls on numpy.
"""

from lalaloc_core.localise.descent import LpoConfig
from lalaloc_core.localise.optimise.optimiser import PoseOptimiser, PoseRefiner

__all__ = ["LpoConfig", "PoseOptimiser", "PoseRefiner"]
