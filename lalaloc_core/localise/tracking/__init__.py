"""Tracking: a Bayes filter that follows a camera from photograph to photograph.

The belief is a histogram over the poses of the grids of one plan or of the plans of a venue (`tracked_plans.py`), and
the sectors of the heading. Begin with `tracking_filter.py`, the path of a photograph: the belief is moved by the
odometry (`walk_motion.py`), also by stairs and lifts, multiplied by the likelihood of the photograph,
and refined by LPO at its modes (`belief_modes.py`). `track_state.py` has the state that is stored between photographs.
"""

from lalaloc_core.localise.tracking.track_state import TrackState
from lalaloc_core.localise.tracking.walk_motion import Odometry
