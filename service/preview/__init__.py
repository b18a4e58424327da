"""Pictures of a stored plan: an SVG drawing and a GLB mesh.

Begin with `drawings.py`, which keeps them; `lalaloc_core.draw` and `mesh.py` make them.
"""

from service.preview.drawings import Drawings

__all__ = ["Drawings"]
