"""Localisability: the probability by place that a photograph taken there is found.

Begin with `predicted_localisability.py`; `localisability_report.py` sums it up in plain data and words.
"""
