"""Generated data sets, and writing them to disk.

Begin with `generated.py`: homes of the generator, rendered on demand. For calibration, `mismatched.py` replaces their
photographs by those of other places, `disturbed.py` degrades them, and `copied.py` puts copies of a home into one plan.
`heldout.py` generates the out-of-distribution homes (extra `oracle`); `writing.py` implements `lalaloc synth`.
"""

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, training_plans
from lalaloc_core.learn.data.synthetic.mismatched import MismatchedScenes
from lalaloc_core.learn.data.synthetic.writing import Synthesis, synthesise

__all__ = ["GeneratedScenes", "MismatchedScenes", "Synthesis", "synthesise", "training_plans"]
