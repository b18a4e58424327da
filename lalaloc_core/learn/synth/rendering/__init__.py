"""Rendering of scenes as spheres: a batched ray caster in torch, and shading.

Begin with `sphere_renderer.py`, the sphere renderer. `cast.py` and `prisms.py` cast rays against walls and furniture,
`shading.py` shades the hits and draws the view through windows.
"""

from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
