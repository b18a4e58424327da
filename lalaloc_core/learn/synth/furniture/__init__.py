"""Furniture of rooms: pieces, and their placement.

Begin with `furnish.py`, which furnishes a room. `pieces.py` defines a piece, `catalogue.py` makes them and lists those
of each kind of room, `built_in.py` has fixed furniture.
Needs no torch.
"""
