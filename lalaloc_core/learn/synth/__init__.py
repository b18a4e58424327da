"""Generator of training data: procedural homes, and photographs of them rendered in torch.

Begin with `rendering/sphere_renderer.py`, the sphere renderer. `homes/` draws floor plans with doors and windows,
`furniture/` furnishes their rooms; `scene/` collects the surroundings of one camera in a `RenderScene`, `rendering/`
casts its rays and shades the hits, `camera.py` exposes the picture. `records.py` stores the rows of numbers of a scene.
"""
