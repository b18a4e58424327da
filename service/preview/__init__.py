"""Pictures of a stored plan. Begin with `drawings.py`, which keeps them; `svg.py` is the drawing, `mesh.py` the GLB."""

from service.preview.drawings import Drawings
from service.preview.svg import Marker

__all__ = ["Drawings", "Marker"]
