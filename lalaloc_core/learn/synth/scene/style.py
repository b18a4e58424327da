"""Style of a house: common properties of its doors, windows and trims."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lalaloc_core.learn.synth.scene.surfaces import Colour, SurfaceTable, bright, paint, vivid, wood_tone


@dataclass(frozen=True, kw_only=True)
class HouseStyle:
    """One style for all rooms of a scene; surfaces are rows of its table.

    Attributes:
        outdoors: view through windows.
        gloom: surface behind the doors of rooms that are seen through doors, and behind panes.
        baseboard_m: height of the baseboards, 0 for none.
        crown_m: height of the mouldings below the ceiling, 0 for none.
    """

    trim: int
    door: int
    door_panel: int
    handle: int
    outdoors: int
    gloom: int
    doors_are_glazed: bool
    baseboard_m: float
    crown_m: float


def sample_style(surfaces: SurfaceTable, rng: np.random.Generator) -> HouseStyle:
    """Draw a style, whose surfaces are added to the table."""
    trim = surfaces.add_plain(bright(rng) if rng.random() < 0.7 else wood_tone(rng))
    door_colour = _door_colour(rng)
    is_plain = rng.random() < 0.6
    return HouseStyle(
        trim=trim,
        door=surfaces.add_plain(door_colour) if is_plain else surfaces.add("furniture", door_colour, scale=0.8),
        door_panel=surfaces.add_plain(np.clip(door_colour * rng.uniform(0.75, 1.15), 0.01, 0.92)),
        handle=surfaces.add_finish("metal"),
        outdoors=surfaces.add_outdoors(math.exp(rng.uniform(0.3, 2.3))),
        gloom=surfaces.add_plain(paint(rng) * math.exp(rng.uniform(math.log(0.08), 0.0))),
        doors_are_glazed=rng.random() < 0.12,
        baseboard_m=rng.uniform(0.04, 0.14) if rng.random() < 0.8 else 0.0,
        crown_m=rng.uniform(0.03, 0.12) if rng.random() < 0.2 else 0.0,
    )


def _door_colour(rng: np.random.Generator) -> Colour:
    kind = rng.random()
    if kind < 0.55:
        return bright(rng)
    return wood_tone(rng) if kind < 0.9 else vivid(rng)
