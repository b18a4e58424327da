"""Scenes: surroundings of one camera in a home as arrays to render (walls, decals, furniture, materials, light).

Begin with `build.py`, which builds the `RenderScene` (`render_scene.py`) of a `Shot` (`shots.py`).
"""

from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import RenderScene
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
