"""Comparison of poses with a query.

Begin with `matching_cost.py`, which has the equations; `cost_terms.py` has the formulas of its terms. `pose_grid.py`
has the poses of a plan and what it shows there, and `coarse_pass.py` selects the poses to compare.
`place_cost.py` has the cost of hints, fixtures and directions of walls. `fit_by_chance.py` costs poses of other homes,
to tell a good cost from chance.
"""

from lalaloc_core.localise.match.fit_by_chance import Cohort, cohort_of, cost_by_chance, log_cost_to_chance
from lalaloc_core.localise.match.matching_cost import MatchingConfig, MatchingCost
from lalaloc_core.localise.match.place_cost import OTHER_LINES, PlaceCost
from lalaloc_core.localise.match.pose_grid import Layouts, PoseGrid, grid_candidate, layouts_at
