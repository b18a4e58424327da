"""Vector drawings, whatever format they came in: which lines are walls, what they enclose, which symbols are doors.

Begin with `understand.py`, from a drawing (`shapes.py`) to rooms and openings; `walls.py` finds what walls enclose,
`scale.py` how long a unit is.
"""
