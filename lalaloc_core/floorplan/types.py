"""Room types from the labels of drawings and data sets."""

from __future__ import annotations

import re
from collections.abc import Mapping

from lalaloc_core.conventions import ROOM_TYPES

_WORDS: Mapping[str, str] = {
    "bath": "bathroom",
    "shower": "bathroom",
    "toilet": "bathroom",
    "wc": "bathroom",
    "restroom": "bathroom",
    "washroom": "bathroom",
    "hall": "corridor",
    "hallway": "corridor",
    "passage": "corridor",
    "landing": "corridor",
    "foyer": "entrance",
    "entry": "entrance",
    "vestibule": "entrance",
    "lobby": "entrance",
    "lounge": "living",
    "family": "living",
    "studio": "living",
    "den": "office",
    "study": "office",
    "workspace": "office",
    "wardrobe": "closet",
    "pantry": "storage",
    "store": "storage",
    "basement": "storage",
    "attic": "storage",
    "utility": "laundry",
    "staircase": "stairs",
    "stairwell": "stairs",
    "stair": "stairs",
    "terrace": "balcony",
    "patio": "balcony",
    "porch": "balcony",
    "deck": "balcony",
    "garden": "balcony",
    "outdoor": "balcony",
    "conference": "meeting",
    "auditorium": "meeting",
    "classroom": "meeting",
    "breakfast": "dining",
    "kitchenette": "kitchen",
    "nursery": "bedroom",
} | {name: name for name in ROOM_TYPES}


def room_type_from_label(label: str) -> str:
    """Return the room type of a label ("Living room 2": living), `unknown` if it has no known word.

    The first known word decides.
    """
    words = re.findall(r"[a-z]+", label.casefold())
    return next((_WORDS[word] for word in words if word in _WORDS), ROOM_TYPES[0])
