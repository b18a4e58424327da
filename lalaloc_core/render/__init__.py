"""The layout renderer: what a camera sees of a plan's bare walls, floor and ceiling, in closed form.

Begin with `profile.py`, which casts rays at walls; `depth.py` adds floor and ceiling, `layout.py` openings and what
lies behind them, `poses.py` does it for poses of a plan, `gradient.py` tells how walls change as a pose moves. The same
lines run on numpy and on torch. `oracle.py` is the slow check of them, which needs the extra `oracle` and is not
re-exported. Photographs are rendered by `synth`.
"""

from lalaloc_core.render.depth import back_project, layout_depth
from lalaloc_core.render.layout import LayoutView, layout_view
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.render.profile import cast_rays, wall_profile

__all__ = ["LayoutView", "back_project", "cast_rays", "layout_depth", "layout_view", "profiles_at", "wall_profile"]
