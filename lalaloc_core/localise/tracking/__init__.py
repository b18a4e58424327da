"""Tracking: a Bayes filter that follows a camera from photograph to photograph.

The belief is a histogram over the poses of the grids of one plan or of the plans of a venue (`ground.py`), and the
sectors of the heading. Begin with `filter.py`, the path of a photograph: the belief is moved by the odometry
(`motion.py`), also by stairs and lifts (`passages.py`), multiplied by the likelihood of the photograph, and refined by
LPO at its modes. `state.py` has what is stored between photographs.
"""

from lalaloc_core.localise.tracking.track_state import TrackState
from lalaloc_core.localise.tracking.walk_motion import Odometry

__all__ = ["Odometry", "TrackState"]
