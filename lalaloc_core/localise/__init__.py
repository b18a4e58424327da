"""Search for the pose of an encoded panorama; service and evaluation run the same code.

Begin with `pipeline.py`, the path of a query: `retrieval.py` compares it with the plan's pose grid, `vogel.py` samples
more poses around the best, `optimise/` refines them (LPO, the only part that imports torch), and `posterior.py`,
`confidence.py` and `covariance.py` state the answer's uncertainty. `matching_cost.py` is the cost by which poses are
compared; `encoders.py` runs the networks on onnxruntime. `venue/` searches several plans as one, `sequence/` localises
several photographs jointly, `tracking/` one after the other. Worker processes load parts of this package, so only plain
values are re-exported.
"""

from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import Candidate, PoseGrid, PredictedProfile, Query, RefinementJob, RefinementResult

__all__ = [
    "Candidate",
    "MatchingConfig",
    "PoseGrid",
    "PredictedProfile",
    "Query",
    "RefinementJob",
    "RefinementResult",
]
