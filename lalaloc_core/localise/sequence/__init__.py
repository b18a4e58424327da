"""Joint localisation of several photographs of one visit: the posterior of each, and of the path.

The state of a picture is a pose of the plan's grid with a heading. Pictures form a chain: the measured motions between
neighbours (`measured_motion.py`) link their states, and all share one error of the camera height.

Begin with `sequence_search.py`, the path of a query. `chain_inference.py` sums over all paths (forward-backward) and
finds the best ones (Viterbi), `path_posterior.py` computes the probability of paths. `joint_refinement.py` refines all
poses of a path together; `path_refinement.py` makes its jobs and reads its results. `turn_localisation.py` is about
photographs from one spot.
"""

from lalaloc_core.localise.sequence.joint_refinement import SequenceJob, SequenceResult
from lalaloc_core.localise.sequence.measured_motion import Motion
