"""Room types from the labels of drawings and data sets."""

from __future__ import annotations

import re

from lalaloc_core.conventions import ROOM_TYPES

# Further words for each room type, besides its name.
_SYNONYMS = {
    "bathroom": ("bath", "shower", "toilet", "wc", "restroom", "washroom"),
    "corridor": ("hall", "hallway", "passage", "landing"),
    "entrance": ("foyer", "entry", "vestibule", "lobby"),
    "living": ("lounge", "family", "studio"),
    "office": ("den", "study", "workspace"),
    "closet": ("wardrobe",),
    "storage": ("pantry", "store", "basement", "attic"),
    "laundry": ("utility",),
    "stairs": ("staircase", "stairwell", "stair"),
    "balcony": ("terrace", "patio", "porch", "deck", "garden", "outdoor"),
    "meeting": ("conference", "auditorium", "classroom"),
    "dining": ("breakfast",),
    "kitchen": ("kitchenette",),
    "bedroom": ("nursery",),
}
_TYPES = {word: kind for kind, words in _SYNONYMS.items() for word in words} | {name: name for name in ROOM_TYPES}


def room_type_from_label(label: str) -> str:
    """Return the room type of a label ("Living room 2": living), `unknown` if it has no known word.

    The first known word decides.
    """
    words = re.findall(r"[a-z]+", label.casefold())
    return next((_TYPES[word] for word in words if word in _TYPES), ROOM_TYPES[0])
