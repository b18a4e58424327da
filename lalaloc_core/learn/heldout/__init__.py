"""Out-of-distribution homes, written apart from the training generator (`synth`), for reporting only.

The homes have other room shapes, furniture, materials and light, as triangle meshes traced by embree. Scores on
them show how well a model generalises. Never train or tune on them, and share no code with `synth`.

Begin with `renderer.py`, which renders; `homes.py` draws the home, `tracing.py` traces its rays. Needs the extra
`oracle`, so nothing is re-exported.
"""
