"""Rendering scenes as panoramas: a batched ray caster in torch, and light on what the rays hit.

Begin with `panorama.py`, the panorama renderer. `cast.py` and `prisms.py` cast rays against walls and furniture,
`shading.py` lights what they hit, `outdoors.py` is what one sees through windows; `contact_sheet.py` is to look at.
"""

from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer

__all__ = ["PanoramaRenderer"]
