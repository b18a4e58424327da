"""What stands in the rooms of a home: pieces of furniture, and finding room for them.

Begin with `furnish.py`, which furnishes a room. `pieces.py` says what a piece is, `pieces_living.py` and
`pieces_service.py` make them, `catalogue.py` says what belongs where, `built_in.py` has what stays when the furniture
goes. Needs no torch.
"""

from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS, FurnitureLevel, furnish

__all__ = ["FURNITURE_LEVELS", "FurnitureLevel", "furnish"]
