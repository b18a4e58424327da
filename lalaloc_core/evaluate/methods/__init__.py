"""Localisation methods: each takes a query and returns the pose after each stage.

Begin with `method.py`, the question and the answer. `lalaloc.py` is this project's search. `icp.py` and
`explicit.py` are the paper's baselines. `similarity.py` retrieves with the true layout or pose.
"""
