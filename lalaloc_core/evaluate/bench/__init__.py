"""`lalaloc bench`: measure the figures of docs/results.md. Each group prints what it measured, with its n.

Begin with `report.py`, which runs the groups, a module each.
"""

from lalaloc_core.evaluate.bench.report import run_bench

__all__ = ["run_bench"]
