"""The generator of training data: procedural homes, and photographs of them rendered in torch.

Begin with `panorama.py`, the panorama renderer. A home comes from `plans.py` (`partition.py`, `openings.py`), its
furniture from `furniture.py`, cameras from `shots.py`. `build.py` puts what one camera sees into a `RenderScene`
(`render_scene.py`), `cast.py` casts its rays, `shading.py` lights what they hit, `camera.py` exposes the picture.
Only what needs no torch is re-exported: data sets use plans of the generator without it.
"""

from lalaloc_core.synth.openings import Opening
from lalaloc_core.synth.plans import Home, generate_home

__all__ = ["Home", "Opening", "generate_home"]
