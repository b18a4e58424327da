"""Plans from pictures: scans, photographs of drawings, screenshots. What comes of them is a draft.

Begin with `sketching.py`: `ink.py` makes ink of grey, `masks.py` finds walls in it, `gaps.py` and `panes.py` doors and
windows, and `plans.drawing.walls` what the walls enclose.
"""

from lalaloc_core.importers.picture.importing import import_picture
from lalaloc_core.importers.picture.sketching import sketch_picture

__all__ = ["import_picture", "sketch_picture"]
