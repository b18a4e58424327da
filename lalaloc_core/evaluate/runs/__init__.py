"""Asking a method about a data set, writing its answers down, and scoring them.

Begin with `run.py`, which asks; `factories.py` finds data set and method, `predictions.py` is the folder that a run
leaves, `score.py` scores it without model or data, `failures.py` sorts what went wrong.
Only what loads no network is re-exported.
"""

from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import score_run

__all__ = ["Prediction", "RunFolder", "RunInfo", "score_run"]
