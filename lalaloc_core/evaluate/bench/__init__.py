"""Benchmarks behind the figures of docs/results.md: `lalaloc bench`.

Begin with `report.py`, which runs the groups of benchmarks.
"""

from lalaloc_core.evaluate.bench.report import run_bench

__all__ = ["run_bench"]
