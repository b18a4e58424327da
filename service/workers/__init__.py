"""Programs of the worker processes: `decode.py` for pictures, `convert.py` for plan files, `lpo.py` for refinement.

Begin with `process.py`, the loop that all of them run. `service.pools` starts and supervises these processes; it is not
loaded in them, and this package re-exports nothing, because every worker would load it.
"""
