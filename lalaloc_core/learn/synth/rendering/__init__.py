"""Rendering of scenes as panoramas: a batched ray caster in torch, and shading.

Begin with `panorama.py`, the panorama renderer. `cast.py` and `prisms.py` cast rays against walls and furniture,
`shading.py` shades the hits and draws the view through windows.
"""

from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer
