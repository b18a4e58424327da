"""Programs of the worker processes: `decode.py` for pictures, `convert.py` for plan files, `lpo.py` for refinement.

Begin with `process.py`, the common loop. `service.pools` starts and supervises these processes. This package re-exports
nothing, because every worker would load it.
"""
