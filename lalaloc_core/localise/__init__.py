"""The search: from an encoded panorama to a pose. The same code serves and is evaluated.

Begin with `pipeline.py`, the path of a query: `retrieval.py` compares it with the plan's grid, `vogel.py` samples more
poses around the best, `optimise/` moves them (LPO, all here that imports torch), `confidence.py` and
`covariance.py` say how sure the answer is. `matching_cost.py` is what poses are compared by, `encoders.py` runs the networks
on onnxruntime. `venue/` searches several plans as one, `sequence/` answers several photographs jointly. Worker
processes load parts of this, so only plain values are re-exported.
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
