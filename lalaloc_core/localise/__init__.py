"""The search: from an encoded panorama to a pose. The same code serves and is evaluated.

Begin with `pipeline.py`, the path of a query: `retrieval.py` compares it with the plan's grid, `vogel.py` samples more
poses around the best, `optimise/` moves them (LPO, all here that imports torch), `confidence.py` and
`covariance.py` say how sure the answer is. `evidence.py` is what poses are compared by, `encoders.py` runs the networks
on onnxruntime. `venue/` searches several plans as one, `sequence/` answers several photographs jointly. Worker
processes load parts of this, so only plain values are re-exported.
"""

from lalaloc_core.localise.evidence import EvidenceConfig
from lalaloc_core.localise.poses import Candidate, LatentGrid, PredictedProfile, Query, RefinementJob, RefinementResult

__all__ = [
    "Candidate",
    "EvidenceConfig",
    "LatentGrid",
    "PredictedProfile",
    "Query",
    "RefinementJob",
    "RefinementResult",
]
