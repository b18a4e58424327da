"""Furniture by kind of room."""

from __future__ import annotations

from lalaloc_core.learn.synth.furniture.pieces import Maker
from lalaloc_core.learn.synth.furniture.pieces_living import (
    bed,
    bench,
    bookcase,
    carton,
    desk,
    dining_table,
    floor_lamp,
    low_table,
    nightstand,
    plant,
    sideboard,
    sofa,
    wardrobe,
)
from lalaloc_core.learn.synth.furniture.pieces_service import (
    bathtub,
    counter,
    fridge,
    island,
    shower,
    toilet,
    washbasin,
)

# Pieces of each kind of room, most characteristic first, with their probabilities.
ROOM_PIECES: dict[str, tuple[tuple[Maker, float], ...]] = {
    "living": (
        *((sofa, 0.95), (sideboard, 0.8), (low_table, 0.8), (dining_table, 0.5), (bookcase, 0.6), (sofa, 0.5)),
        *((island, 0.25), (counter, 0.25), (floor_lamp, 0.5), (plant, 0.6), (sofa, 0.3), (plant, 0.3), (desk, 0.2)),
        *((wardrobe, 0.15), (carton, 0.4), (carton, 0.3), (sideboard, 0.3)),
    ),
    "bedroom": (
        *((bed, 0.95), (wardrobe, 0.85), (nightstand, 0.7), (nightstand, 0.4), (sideboard, 0.5), (desk, 0.35)),
        *((wardrobe, 0.25), (bookcase, 0.3), (plant, 0.3), (floor_lamp, 0.25), (carton, 0.4)),
        *((sofa, 0.15), (carton, 0.3)),
    ),
    "kitchen": (
        *((counter, 1.0), (counter, 0.75), (fridge, 0.8), (island, 0.45), (dining_table, 0.6), (counter, 0.3)),
        *((sideboard, 0.2), (carton, 0.5), (plant, 0.2), (carton, 0.3)),
    ),
    "dining": (
        *((dining_table, 1.0), (sideboard, 0.8), (bookcase, 0.3), (plant, 0.5), (floor_lamp, 0.3)),
        *((sofa, 0.2), (carton, 0.3)),
    ),
    "study": (
        *((desk, 0.95), (bookcase, 0.8), (bookcase, 0.5), (wardrobe, 0.3), (sofa, 0.4), (sideboard, 0.3)),
        *((plant, 0.3), (floor_lamp, 0.3), (carton, 0.5), (carton, 0.4)),
    ),
    "bathroom": (
        *((washbasin, 0.95), (toilet, 0.9), (bathtub, 0.5), (shower, 0.6), (wardrobe, 0.2)),
        *((carton, 0.5), (sideboard, 0.2)),
    ),
    "corridor": ((bench, 0.4), (sideboard, 0.4), (wardrobe, 0.35), (plant, 0.3), (bookcase, 0.2), (carton, 0.5)),
    "closet": ((wardrobe, 0.6), (bookcase, 0.7), (carton, 0.7), (carton, 0.6), (carton, 0.5), (carton, 0.4)),
}
ROOM_PIECES["storage"] = ROOM_PIECES["closet"]
