"""Pictures of stored plans: SVG drawings and GLB meshes.

Begin with `drawings.py`, which caches them. `lalaloc_core.draw.plan` makes the drawings and `mesh.py` the meshes.
"""

from service.preview.drawings import Drawings

__all__ = ["Drawings"]
