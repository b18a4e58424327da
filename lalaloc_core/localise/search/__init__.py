"""Search of a plan: retrieve, re-sample, refine, rank.

Begin with `pipeline.py`, the path of a query. `retrieval.py` compares the query with the plan's pose grid (paper,
section 4.1), and with more poses around the best (VDR).
"""
