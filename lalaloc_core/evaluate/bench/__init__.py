"""Benchmarks behind the figures of docs/results.md: `lalaloc bench`.

Begin with `bench_groups.py`, which runs them by name.
"""
