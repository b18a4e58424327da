"""Colours of walls, doors, windows and passages: the same in plans, over photographs and on the page.

Readers with protanopia and deuteranopia can tell them apart, and the importer of pictures reads brown doors and blue
windows. The page's style sheet repeats them, with lighter ones for plans on a dark ground.
"""

from __future__ import annotations

from typing import Final

# Plans on a light ground.
ON_PAPER: Final = {"wall": "#20242c", "door": "#b5651d", "window": "#2b7fc9", "passage": "#8c939c"}
# Lines over photographs, with a dark edge.
ON_PHOTOGRAPH: Final = {"wall": "#ffe14d", "door": "#e8702a", "window": "#4aa8ff", "passage": "#ffffff"}
