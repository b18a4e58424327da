"""The wing that measures models: methods, runs, reports, benchmarks, tables.

Begin with `runs/run.py`.
"""
