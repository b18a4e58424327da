"""Generated data sets, and writing them to disk.

Begin with `generated.py`: homes of the generator, rendered on demand. For calibration, `altered_homes.py` degrades or
replaces their photographs, or asks for them in other plans; `writing.py` implements `lalaloc lab synth`.
"""

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, training_plans
