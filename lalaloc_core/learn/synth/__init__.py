"""The generator of training data: procedural homes, and photographs of them rendered in torch.

Begin with `rendering/panorama.py`, the panorama renderer. `homes/` draws floor plans with doors and windows,
`furniture/` furnishes their rooms; `scene/` puts what one camera sees into a `RenderScene`, `rendering/` casts its rays
and lights what they hit, `camera/` exposes the picture. `records.py` is how scenes keep rows of numbers.
Only what needs no torch is re-exported: data sets use plans of the generator without it.
"""

from lalaloc_core.learn.synth.homes import Home, Opening, generate_home

__all__ = ["Home", "Opening", "generate_home"]
