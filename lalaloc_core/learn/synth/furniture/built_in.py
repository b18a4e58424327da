"""Built-in furniture that stays in empty rooms: kitchens, wall-to-wall wardrobes, sanitary ware.

It stands along walls, hides their foot, and is easily mistaken for the wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lalaloc_core.learn.synth.furniture import catalogue
from lalaloc_core.learn.synth.furniture.pieces import Finish, Piece, box

_MIN_RUN_M = 1.2
_MAX_RUN_M = 6.0
_TALL_UNIT_M = 0.6
# Width of the place of a fridge.
_FRIDGE_M = 0.92
_MAX_SHELVED_WALLS = 3


class Stretch(NamedTuple):
    """A stretch of wall without doors: wall, start and end along it (m), and if a window is above worktop height."""

    wall: int
    start_m: float
    end_m: float
    has_window: bool

    @property
    def length_m(self) -> float:
        """Length of the stretch (m)."""
        return self.end_m - self.start_m


class Placed(NamedTuple):
    """A piece with its back to a wall: position of its middle along the wall, and distance of its back (m)."""

    piece: Piece
    wall: int
    middle_m: float
    from_wall_m: float = 0.0


def kitchen(
    stretches: list[Stretch],
    lengths_m: Float[np.ndarray, "n"],
    ceiling_m: float,
    rng: np.random.Generator,
    *,
    fitted: bool = False,
) -> list[Placed]:
    """Return a run of units along a wall, sometimes around a corner, with tall units, an island or a peninsula.

    `stretches` are free stretches of wall, and `lengths_m` the lengths of the room's walls, in order. A `fitted`
    kitchen has a fridge in its run, wall units up to the ceiling, and things on its worktops.
    """
    usable = [stretch for stretch in stretches if stretch.length_m > _MIN_RUN_M]
    if not usable:
        return []
    weights = np.array([stretch.length_m for stretch in usable])
    main = usable[int(rng.choice(len(usable), p=weights / weights.sum()))]
    length = min(main.length_m, _MAX_RUN_M)
    if rng.random() < 0.4:
        length = rng.uniform(_MIN_RUN_M, length)
    start = main.start_m if rng.random() < 0.5 else main.end_m - length
    body: Finish = ("white", "wood", "paint")[int(rng.integers(3))]
    height = rng.uniform(0.85, 0.95)
    has_wall_units = rng.random() < 0.75 and not main.has_window
    placed = []
    if fitted and length > _MIN_RUN_M + _FRIDGE_M:
        at_start = rng.random() < 0.5
        placed.append(Placed(catalogue.fridge(rng), main.wall, start + 0.46 if at_start else start + length - 0.46))
        start, length = start + (_FRIDGE_M if at_start else 0.0), length - _FRIDGE_M
    if length > _MIN_RUN_M + _TALL_UNIT_M and rng.random() < 0.5 and not main.has_window:
        # A tall unit or a fridge closes the run on one side.
        top = min(rng.uniform(1.9, 2.4), ceiling_m - 0.02)
        tall = _tall_unit(body, top)
        at_start = rng.random() < 0.5
        placed.append(Placed(tall, main.wall, start + 0.3 if at_start else start + length - 0.3))
        start, length = start + (_TALL_UNIT_M if at_start else 0.0), length - _TALL_UNIT_M
    run = catalogue.counter_run(
        rng, length, height, body, wall_units=has_wall_units, ceiling_m=ceiling_m if fitted else None
    )
    placed.append(Placed(run, main.wall, start + 0.5 * length))
    placed += _around_the_corner(stretches, lengths_m, main, (start, start + length), height, body, rng)
    kind = rng.random()
    if kind < 0.25:
        # A peninsula: its back to the run, its end to the room.
        reach = rng.uniform(0.9, 2.0)
        end = start + 0.32 if rng.random() < 0.5 else start + length - 0.32
        placed.append(Placed(_block(0.6, reach, height, body), main.wall, end, catalogue.COUNTER_DEPTH_M + 0.01))
    elif kind < 0.55:
        width = min(rng.uniform(1.0, 2.6), length)
        island = _block(width, rng.uniform(0.55, 1.05), height, body)
        placed.append(
            Placed(island, main.wall, start + 0.5 * length, catalogue.COUNTER_DEPTH_M + rng.uniform(0.85, 1.3))
        )
    return placed


def wardrobes(stretches: list[Stretch], ceiling_m: float, rng: np.random.Generator) -> list[Placed]:
    """Return wardrobes that fill a wall from end to end, usually up to the ceiling."""
    usable = [stretch for stretch in stretches if 0.9 < stretch.length_m < 5.0 and not stretch.has_window]
    if not usable:
        return []
    chosen = usable[int(rng.integers(len(usable)))]
    height = ceiling_m - 0.005 if rng.random() < 0.6 else min(rng.uniform(2.0, 2.4), ceiling_m - 0.02)
    width = chosen.length_m if rng.random() < 0.75 else rng.uniform(0.9, chosen.length_m)
    start = chosen.start_m if rng.random() < 0.5 else chosen.end_m - width
    return [Placed(catalogue.wardrobe_run(rng, width - 0.01, height), chosen.wall, start + 0.5 * width)]


def closet_shelves(stretches: list[Stretch], ceiling_m: float, rng: np.random.Generator) -> list[Placed]:
    """Return open shelves and rails with clothes along one to three walls of a walk-in closet."""
    depth, height = rng.uniform(0.3, 0.6), min(rng.uniform(1.9, 2.4), ceiling_m - 0.02)
    usable = sorted((s for s in stretches if s.length_m > 0.6 and not s.has_window), key=lambda s: -s.length_m)
    placed: list[Placed] = []
    for stretch in usable[: int(rng.integers(1, _MAX_SHELVED_WALLS + 1))]:
        # Later runs leave the corners to earlier ones.
        margin = depth + 0.02 if placed else 0.0
        length = stretch.length_m - 2 * margin - 0.01
        if length > 0.5:
            middle = 0.5 * (stretch.start_m + stretch.end_m)
            placed.append(Placed(catalogue.shelf_run(rng, length, depth, height), stretch.wall, middle))
    return placed


def sanitary(rng: np.random.Generator) -> list[Piece]:
    """Return the sanitary ware of a bathroom."""
    pieces = [catalogue.washbasin(rng), catalogue.toilet(rng)]
    return [*pieces, catalogue.bathtub(rng) if rng.random() < 0.5 else catalogue.shower(rng)]


def _around_the_corner(
    stretches: list[Stretch],
    lengths_m: Float[np.ndarray, "n"],
    main: Stretch,
    run_m: tuple[float, float],
    height: float,
    body: Finish,
    rng: np.random.Generator,
) -> list[Placed]:
    """Continue the run along the next wall if it reaches a corner."""
    if rng.random() > 0.6 or run_m[1] < lengths_m[main.wall] - 0.1:
        return []
    following = (main.wall + 1) % len(lengths_m)
    beside = [s for s in stretches if s.wall == following and s.start_m < 0.1]
    if not beside:
        return []
    start = catalogue.COUNTER_DEPTH_M + 0.01
    length = min(rng.uniform(0.6, 3.0), beside[0].end_m - start)
    if length < 0.6:
        return []
    return [Placed(catalogue.counter_run(rng, length, height, body, wall_units=False), following, start + 0.5 * length)]


def _tall_unit(body: Finish, height: float) -> Piece:
    half, front = 0.5 * _TALL_UNIT_M, 0.31
    oven = box(at=(0.0, front - 0.01), half=(half - 0.03, 0.012), z=(0.9, 1.45), finish="dark")
    parts = (
        box(at=(0.0, -0.01), half=(half, front - 0.01), z=(0.0, height), finish=body),
        oven,
        box(at=(0.0, front - 0.005), half=(half - 0.01, 0.008), z=(1.5, height - 0.02), finish=body),
    )
    return Piece(_TALL_UNIT_M, 0.62, parts, label="counter")


def _block(width: float, depth: float, height: float, body: Finish) -> Piece:
    hx, hy = 0.5 * width, 0.5 * depth
    parts = [
        box(at=(0.0, 0.0), half=(hx - 0.05, hy - 0.05), z=(0.0, 0.1), finish="dark"),
        box(at=(0.0, 0.0), half=(hx - 0.02, hy - 0.03), z=(0.1, height - 0.04), finish=body),
        box(at=(0.0, 0.0), half=(hx, hy), z=(height - 0.04, height), finish="stone"),
    ]
    for k in range(max(1, math.floor(width / 0.6))):
        x = -hx + width * (k + 0.5) / max(1, math.floor(width / 0.6))
        parts.append(box(at=(x, hy - 0.025), half=(0.12, 0.008), z=(height - 0.14, height - 0.12), finish="metal"))
    return Piece(width, depth, tuple(parts), label="counter")
