"""What a camera makes of the light that falls into it: exposure, lenses, stitching, patches at the poles, compression.

Begin with `develop.py`, which turns radiance into bytes; `exposure.py` has the settings and samples them.
"""

from lalaloc_core.learn.synth.camera.exposure import Exposure

__all__ = ["Exposure"]
