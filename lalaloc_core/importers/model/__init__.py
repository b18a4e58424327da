"""What all importers share: options, limits, the sketch that they fill in, and the plan that becomes of it.

Begin with `sketch.py`, then `assemble.py`, which makes a plan of it; `settle.py` puts openings into walls, `checks.py`
says what is likely wrong, `words.py` knows what layers and rooms are called.
"""
