"""Layout renderer: bare walls, floor and ceiling of a plan from the pose of a camera, in closed form.

Begin with `sweep.py`, which renders many poses of a plan at once, for numpy only; search and training use it.
`profile.py` casts rays from poses at walls, adds floor and ceiling, and computes derivatives by the pose. It runs on
numpy and on torch alike, for the encoders and for refinement. `sampling.py` draws poses. Photographs are rendered by
`learn/synth`.
"""
