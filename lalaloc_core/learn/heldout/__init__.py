"""Out-of-distribution homes, written apart from the training generator (`synth`), for reporting only.

Other room shapes, furniture, materials and light, real triangle meshes traced by embree: what a model scores here and
not only on the generator's own test homes it has not learnt by heart. Nothing may be trained or tuned on them, and
nothing here may be shared with `synth`.

Begin with `photograph.py`, which renders; `homes.py` draws the home, `tracing.py` traces its rays. Needs the extra
`oracle`, so nothing is re-exported.
"""
