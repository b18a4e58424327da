"""Several photographs of one visit, answered jointly: the posterior of each, and of the path.

Every picture has one state, a pose of the plan's grid with a heading. Pictures are a chain: what was measured of the
motion between two of them (`motion.py`) links their states, and all share one error of the camera height.

Begin with `search.py`, the path of a query. `chain.py` sums over all paths (forward-backward) and finds the best ones
(Viterbi), `joint.py` optimises all poses of a path together, `refinement.py` is what goes there and comes back,
`paths.py` says how probable paths are.
"""

from lalaloc_core.localise.sequence.joint import SequenceJob, SequenceResult
from lalaloc_core.localise.sequence.motion import Motion

__all__ = ["Motion", "SequenceJob", "SequenceResult"]
