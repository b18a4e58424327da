"""Descent to the pose that fits best, on the array API: numpy for wall profiles, torch for embeddings.

The derivatives of wall profiles are in closed form, so models that compare walls need neither gradients nor torch
(`walls.py`). Embeddings of layouts, usually networks, are differentiated by torch (`localise.optimise`). Begin with
`problem.py`, the cost of poses and its derivatives; `methods.py` has the two optimisers.
"""

from lalaloc_core.localise.descent.problem import LpoConfig
from lalaloc_core.localise.descent.walls import refine_walls, refined_by_walls

__all__ = ["LpoConfig", "refine_walls", "refined_by_walls"]
