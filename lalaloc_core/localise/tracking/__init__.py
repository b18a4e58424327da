"""Tracking: a Bayes filter that follows a camera from photograph to photograph.

The belief is a histogram over the poses of the plan's grid and the sectors of the heading. Begin with `filter.py`, the
path of a photograph: the belief is moved by the odometry (`motion.py`), multiplied by the likelihood of the photograph,
and refined by LPO at its modes. `state.py` has what is stored between photographs.
"""

from lalaloc_core.localise.tracking.motion import Odometry
from lalaloc_core.localise.tracking.state import TrackState

__all__ = ["Odometry", "TrackState"]
