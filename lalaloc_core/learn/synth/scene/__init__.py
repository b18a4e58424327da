"""Scenes: surroundings of one camera in a home as arrays to render (walls, decals, furniture, materials, light).

Begin with `build.py`, which builds the `RenderScene` (`render_scene.py`) of a `Shot` (`shots.py`).
"""
