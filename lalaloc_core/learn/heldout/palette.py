"""Materials of a home."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lalaloc_core.learn.heldout.outlines import RoomKind
from lalaloc_core.learn.heldout.procedural_materials import Surface

_FLOORS = ("planks", "planks", "planks", "checker", "tiles", "hexagons", "marble", "cloth")
_WALLS = ("plain", "plain", "plaster", "plaster", "stripes", "dots", "brick")
_WET_WALLS = ("tiles", "tiles", "plain", "hexagons", "marble")


def _hsv(hue: float, saturation: float, value: float) -> Float[np.ndarray, "3"]:
    k = (np.array([5.0, 3.0, 1.0]) + hue * 6) % 6
    return (value - value * saturation * np.clip(np.minimum(k, 4 - k), 0, 1)) ** 2.2


def _woody(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    return _hsv(rng.uniform(0.05, 0.1), rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.85))


def _floor(kind: RoomKind, rng: np.random.Generator) -> Surface:
    pattern = str(rng.choice(_FLOORS[3:-1] if kind in ("bathroom", "kitchen") else _FLOORS))
    turn = float(rng.choice([0.0, np.pi / 2, np.pi / 4, rng.uniform(0, 3.14)]))
    if pattern == "planks":
        colour = _woody(rng)
        size_m, gloss = rng.uniform(0.6, 1.2), rng.choice([0.0, 0.03, 0.08])
        return Surface(pattern, colour, colour * 0.35, size_m=size_m, turn=turn, gloss=gloss)
    if pattern == "cloth":
        colour = _hsv(rng.random(), rng.uniform(0.0, 0.5), rng.uniform(0.35, 0.75))
        return Surface(pattern, colour, colour * 0.6, size_m=1.0, turn=turn)
    colour = _hsv(rng.uniform(0.0, 0.7), rng.uniform(0.0, 0.25), rng.uniform(0.5, 0.95))
    contrast = rng.uniform(0.15, 0.8)
    size_m, gloss = rng.uniform(0.3, 0.9), rng.uniform(0.02, 0.12)
    return Surface(pattern, colour, colour * contrast, size_m=size_m, turn=turn, gloss=gloss)


def _wall(kind: RoomKind, rng: np.random.Generator) -> Surface:
    pattern = str(
        rng.choice(
            _WET_WALLS if kind == "bathroom" else _WALLS,
            p=None if kind == "bathroom" else (0.26, 0.16, 0.16, 0.14, 0.12, 0.08, 0.08),
        )
    )
    pale = rng.random() < 0.65
    # Most walls have warm colours.
    hue = rng.uniform(0.02, 0.17) if rng.random() < 0.6 else rng.random()
    colour = _hsv(
        hue,
        rng.uniform(0, 0.12) if pale else rng.uniform(0.12, 0.42),
        rng.uniform(0.8, 0.97) if pale else rng.uniform(0.45, 0.85),
    )
    if pattern == "brick":
        colour = _hsv(rng.uniform(0.0, 0.09), rng.uniform(0.1, 0.65), rng.uniform(0.5, 0.85))
    second = np.clip(colour * rng.uniform(0.55, 0.9), 0, 1) if pattern != "brick" else np.full(3, 0.55)
    skirting = _hsv(0.08, rng.uniform(0, 0.4), rng.uniform(0.3, 0.95)) if rng.random() < 0.75 else None
    size_m, gloss = rng.uniform(0.25, 0.7), 0.03 if kind == "bathroom" else 0.0
    return Surface(pattern, colour, second, size_m=size_m, gloss=gloss, skirting=skirting)


def room_surfaces(kinds: Sequence[RoomKind], rng: np.random.Generator) -> list[dict[str, Surface]]:
    """Draw floor, wall and ceiling of each room; many homes repeat one wall and one floor."""
    shared_floor, shared_wall = _floor("living", rng), _wall("living", rng)
    uniform = rng.random() < 0.4
    white = _hsv(0.1, rng.uniform(0.0, 0.06), rng.uniform(0.88, 0.97))
    ceiling = Surface("plain", white, white)
    beam = _woody(rng)
    wooden = Surface("planks", beam, beam * 0.5, size_m=0.9, turn=float(rng.choice([0.0, np.pi / 2])))
    rooms = []
    for kind in kinds:
        wet = kind == "bathroom"
        rooms.append(
            {
                "floor": shared_floor if not wet and rng.random() < 0.7 else _floor(kind, rng),
                "wall": shared_wall if not wet and (uniform or rng.random() < 0.3) else _wall(kind, rng),
                "ceiling": wooden if rng.random() < 0.08 else ceiling,
            }
        )
    return rooms


def thing_surfaces(rng: np.random.Generator) -> dict[str, Surface]:
    """Draw the materials of furniture, doors and frames, by the surface names of their parts."""

    def cloth() -> Surface:
        colour = _hsv(rng.random(), rng.uniform(0.0, 0.6), rng.uniform(0.25, 0.9))
        return Surface(
            str(rng.choice(["cloth", "cloth", "stripes", "dots"])),
            colour,
            colour * rng.uniform(0.4, 0.8),
            size_m=rng.uniform(0.06, 0.25),
        )

    def wood() -> Surface:
        colour = _woody(rng)
        return Surface("wood", colour, colour * 0.5, gloss=0.02)

    accent = _hsv(rng.random(), rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9))
    bright, black = np.full(3, 0.8), np.full(3, 0.02)
    frame = _woody(rng) if rng.random() < 0.3 else np.full(3, rng.choice([0.75, 0.8, 0.08]))
    door = _hsv(rng.random(), 0.4, 0.6) if rng.random() < 0.2 else frame
    rug = _hsv(rng.random(), rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.8))
    curtain = _hsv(rng.random(), rng.uniform(0.0, 0.4), rng.uniform(0.5, 0.95))
    return {
        "fabric a": cloth(),
        "fabric b": cloth(),
        "fabric c": cloth(),
        "wood a": wood(),
        "wood b": wood(),
        "accent": Surface("plain", accent, accent),
        "white": Surface("plain", bright, bright),
        "dark": Surface("plain", black, black, gloss=0.03),
        "metal": Surface("plain", np.full(3, 0.35), np.full(3, 0.35), gloss=0.25),
        "ceramic": Surface("plain", np.full(3, 0.78), np.full(3, 0.78), gloss=0.05),
        "stone": Surface("marble", rng.uniform(0.1, 0.7) * np.ones(3), np.full(3, 0.3), gloss=0.05),
        "leaf": Surface("leaf", np.array([0.06, 0.2, 0.03]), np.array([0.16, 0.3, 0.06])),
        "frame": Surface("plain", frame, frame),
        "door": Surface("wood" if rng.random() < 0.4 else "plain", door, door * 0.7),
        "mirror": Surface("plain", np.full(3, 0.02), np.full(3, 0.02), gloss=0.88),
        "rug": Surface("blotches", rug, _hsv(rng.random(), 0.5, 0.7)),
        "curtain": Surface("cloth", curtain, curtain * 0.8),
        "shade": Surface("plain", bright, bright, glow=1.0),
    }
