"""The layout renderer: what a camera sees of a plan's bare walls, floor and ceiling, in closed form.

Begin with `profile.py`, which casts rays at walls; `depth.py` adds floor and ceiling, `layout.py` openings and what
lies behind them, `gradient.py` tells how walls change as a pose moves. The same lines run on numpy and on torch. Many
poses of a plan, which is most of what search and training ask for, are drawn by `sweep.py`, for numpy alone: of every
wall the columns that it fills, not of every column all walls; `poses.py` is its door for wall profiles. `reference.py`
is the slow check of all, which needs the extra `oracle` and is not re-exported. Photographs are rendered by `synth`.
"""

from lalaloc_core.render.depth import back_project, layout_depth
from lalaloc_core.render.layout import LayoutView, layout_view
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.render.profile import cast_rays, wall_profile

__all__ = ["LayoutView", "back_project", "cast_rays", "layout_depth", "layout_view", "profiles_at", "wall_profile"]
