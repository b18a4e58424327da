"""Pose optimisation (LPO; paper, section 4.2.1): move a pose until its layout fits what the picture says.

In the paper `min over pose of | Φ_layout(Ω(pose, plan)) - f |₂`, latents, with the renderer Ω. Where the model predicts
a wall profile with its uncertainty, the layout's profile is compared with that, by the cost of `localise.matching_cost`. Two
optimisers share one evaluation (residuals and their derivatives by 2 or 3 unknowns; the log of true over stated camera
height is one more where profiles are compared):

* Levenberg-Marquardt (default): under 15 evaluations, and more exact.
* Adam with the paper's schedule (section A.3): the reference.

Several starting poses are refined as one batch; every pose stays inside the room it started in. The derivatives of the
renderer are in closed form (`render.gradient`); those of what is made of a layout, a network as a rule, are taken by
forward-mode differentiation. It may be any differentiable function of a layout (`PoseOptimiser`): comparing layouts
themselves in place of their latents is a baseline of the paper's.

Begin with `optimiser.py`; `problem.py` has the evaluation, `descent.py` the two optimisers.
"""

from lalaloc_core.localise.optimise.config import LpoConfig
from lalaloc_core.localise.optimise.optimiser import PoseOptimiser, PoseRefiner

__all__ = ["LpoConfig", "PoseOptimiser", "PoseRefiner"]
