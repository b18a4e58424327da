"""Panoramas as files: decoding, and completing and levelling the sphere by its metadata.

Begin with `images.py`. `pictures.py` decodes files, also for `photograph/`; `photo_sphere.py` reads the metadata,
`levelling.py` rotates the sphere, and `segments.py` refuses files that are costly to decode.
"""

from lalaloc_core.panorama.images import Panorama, PanoramaLimits, read_panorama

__all__ = ["Panorama", "PanoramaLimits", "read_panorama"]
