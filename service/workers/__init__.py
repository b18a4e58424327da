"""Worker processes: `process.py` has their common loop, `lpo.py` the program that refines poses.

Begin with `process.py`. Programs for photographs and plan files are in `decoding/` and `plan_files/`. `service.pools`
starts and supervises these processes. This package re-exports nothing, because every worker would load it.
"""
