"""Pose refinement (LPO; paper, section 4.2.1): move a pose until its layout fits the predictions.

Begin with `refinement.py`, which makes jobs of candidates and candidates of results.
`refinement_problem.py` has the cost of poses and its derivatives, `descent_methods.py` the two optimisers and the
refinement by wall profiles on numpy; `latent_refiner.py` refines by latents on torch. Worker processes load this
package, so it exports plain values and the refiner on numpy alone.
"""

from lalaloc_core.localise.refine.descent_methods import refine_walls, refined_by_walls
from lalaloc_core.localise.refine.refinement_problem import LpoConfig, Problem, RefinementJob, RefinementResult
