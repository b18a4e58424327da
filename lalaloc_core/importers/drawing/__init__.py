"""Vector drawings of any format: walls, the rooms they enclose, and the symbols of doors and windows.

Begin with `sketching.py`, which turns a drawing (`shapes.py`) into rooms and openings. `walls.py` finds the rooms that
walls enclose, `leaves.py` takes out the leaves of doors, and `scale.py` the length of a unit.
"""
