"""Pictures of a stored plan: an SVG drawing and a GLB mesh.

Begin with `drawings.py`, which keeps them; `svg.py` and `mesh.py` make them.
"""

from service.preview.drawings import Drawings
from service.preview.svg import Marker

__all__ = ["Drawings", "Marker"]
