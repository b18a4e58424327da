"""Everything that can be a row of a table: each answers a question with the pose after each of its stages.

Begin with `method.py`, the question and the answer. `lalaloc.py` is this project's own search, `icp.py`, `explicit.py`
and `decode.py` are what the paper compares with, `oracle.py` knows the truth.
"""

from lalaloc_core.evaluate.methods.method import Answer, FoundPose, Method, Question

__all__ = ["Answer", "FoundPose", "Method", "Question"]
