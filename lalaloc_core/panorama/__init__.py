"""Panoramas as files: decoding any picture, completing and levelling the sphere by its metadata.

Begin with `images.py`; `photo_sphere.py` reads the metadata, `levelling.py` turns the sphere.
"""

from lalaloc_core.panorama.images import Panorama, PanoramaLimits, read_panorama

__all__ = ["Panorama", "PanoramaLimits", "read_panorama"]
