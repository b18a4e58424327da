"""Camera model: exposure, lenses, stitching, patches at the poles, compression.

Begin with `develop.py`, which turns radiance into bytes; `exposure.py` defines and samples the settings.
"""

from lalaloc_core.learn.synth.camera.exposure import Exposure
