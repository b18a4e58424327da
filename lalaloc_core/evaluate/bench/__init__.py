"""Benchmarks behind the figures of docs/results.md: `lalaloc bench`.

Begin with `benchmarks.py`, which runs the groups of benchmarks.
"""

from lalaloc_core.evaluate.bench.benchmarks import run_bench
