"""Vector drawings of any format: walls, the rooms they enclose, and the symbols of doors and windows.

Begin with `sketch_drawing.py`, which turns a drawing (`vector_drawing.py`) into rooms and openings. `enclosed_rooms.py`
finds the rooms that walls enclose, `door_leaves.py` takes out the leaves of doors, and `drawing_scale.py` finds the
length of a unit.
"""
