"""Photographs of any projection: camera, tilt, and level patches for the network.

Begin with `photograph.py`, which reads a file. `projection.py` decides what a picture is, from the caller's statements
(`stated_camera.py`), metadata (`exif.py`, `photo_sphere.py`) and its pixels. `spheres.py` reads full spheres; of other
photographs, `levelling.py` estimates tilt and field of view from straight lines, and `patches.py` samples through the
models of `cameras.py`. `picture_files.py` opens files; `sphere_formats.py` tells pictures that hold a sphere otherwise
than as they should.

Photographs of one spot tell their angles to each other by `overlap.py` and `turn_angles.py`; `turned.py` cuts their
patches by these. `film.py` chooses frames of a film of a turn, by the motion that `film_motion.py` follows.
"""

from lalaloc_core.photograph.patches import Patch, PatchSize
from lalaloc_core.photograph.photograph import Assumed, Photograph, PhotographFeatures, open_photograph
from lalaloc_core.photograph.stated_camera import Intrinsics, StatedCamera
