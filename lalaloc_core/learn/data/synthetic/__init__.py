"""Data sets that are drawn, not read, and writing them to disk.

Begin with `generated.py`, homes of the generator rendered when they are looked at. For calibration `mismatched.py`
asks them with photographs of others, `disturbed.py` with worse ones; `heldout.py` draws the out-of-family homes,
which need the extra `oracle`; `writing.py` is `lalaloc synth`.
"""

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, training_plans
from lalaloc_core.learn.data.synthetic.mismatched import MismatchedScenes
from lalaloc_core.learn.data.synthetic.writing import Synthesis, synthesise

__all__ = ["GeneratedScenes", "MismatchedScenes", "Synthesis", "synthesise", "training_plans"]
