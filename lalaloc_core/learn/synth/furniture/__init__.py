"""Furniture of rooms: pieces, and their placement.

Begin with `furnish.py`, which furnishes a room and lists the pieces of each kind of room. `pieces.py` defines a piece,
`pieces_living.py` and `pieces_service.py` make them, `built_in.py` has fixed furniture.
Needs no torch.
"""

from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS, FurnitureLevel, furnish
