"""Evaluation of models: methods, runs, calibration, reports, benchmarks and the paper's tables.

Begin with `runs/evaluation.py`, which evaluates a model; `calibrate/calibration.py` calibrates one.
"""
