"""Localisability: the probability by place that a photograph taken there is found.

Begin with `predicted_localisability.py`; `next_step.py` finds the step that would make an
unsure answer surest. `reports.py` has both in plain data and words.
"""
