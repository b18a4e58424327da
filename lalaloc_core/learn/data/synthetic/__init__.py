"""Generated data sets, and writing them to disk.

Begin with `generated.py`: homes of the generator, rendered on demand. For calibration, `altered_photographs.py`
degrades or replaces their photographs, and `altered_plans.py` asks for them in other plans; `writing.py` implements
`lalaloc lab synth`.
"""

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, training_plans
