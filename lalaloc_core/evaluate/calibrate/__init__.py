"""Calibration of a model bundle on generated validation homes: `lalaloc lab calibrate`.

Begin with `calibration.py`, the procedure. It fits the weights of the matching cost and the confidence
(`parameter_fits.py`), and what openings look like in photographs. `measured_errors.py` measures the errors of the
networks, `turn_confidence.py` fits the confidence of turns.
"""
