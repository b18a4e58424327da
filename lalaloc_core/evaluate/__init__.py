"""Evaluation of models: methods, runs, reports, benchmarks and the paper's tables.

Begin with `runs/run.py`.
"""
