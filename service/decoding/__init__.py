"""Decoding of photographs in worker processes.

Begin with `decoder.py`, the pool of workers; `decode_worker.py` is their program.
"""
