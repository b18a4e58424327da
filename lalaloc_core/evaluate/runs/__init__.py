"""Evaluation runs: a method localises the queries of a data set, the predictions are stored and scored.

Begin with `evaluation.py`, which evaluates a method. `factories.py` builds data set and method, `predictions.py` reads
and writes the folder of a run, `score.py` scores it without model or data and classifies the failures.
"""
