"""Photographs of any projection: camera, tilt, and level patches for the network.

Begin with `view.py`, which reads a file. `projection.py` decides what a picture is, from the caller's statements
(`stated.py`), metadata (`exif.py`, `panorama/photo_sphere.py`) and its pixels; `levelling.py` estimates tilt and field
of view from the segments of `lines.py`; `patches.py` samples through the models of `cameras.py`.
"""

from lalaloc_core.photograph.patches import Patch, PatchSize
from lalaloc_core.photograph.stated import Intrinsics, StatedView
from lalaloc_core.photograph.view import Assumed, Encoded, View, open_view

__all__ = ["Assumed", "Encoded", "Intrinsics", "Patch", "PatchSize", "StatedView", "View", "open_view"]
