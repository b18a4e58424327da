"""Training of models: data sets, synthetic homes, training and export.

Begin with `training/run.py`.
"""
