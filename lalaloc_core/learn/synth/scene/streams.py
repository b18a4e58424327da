"""The random numbers that a scene is drawn from: one stream for shapes, one for materials."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class ScenePart(IntEnum):
    """Parts of a scene that draw from streams of their own where the scene is staged."""

    MOOD = 0
    ROOM = 1
    FLOOR = 2
    ACCENT = 3
    TRIM = 4
    OPENING = 5
    RADIATOR = 6
    FURNITURE = 7
    LAMPS = 8
    CAMERA = 9
    MATERIALS = 10


class Streams:
    """The streams of one scene.

    Args:
        seed: of the shot.
        is_staged: whether every part begins anew, see `begin`.

    Attributes:
        shapes: decides everything but materials.
        materials: has its own stream because shapes must not depend on what pictures there are.
    """

    def __init__(self, seed: int, *, is_staged: bool) -> None:
        self._seed, self.is_staged = seed, is_staged
        self.shapes = np.random.default_rng(seed)
        self.materials = np.random.default_rng([seed, ScenePart.MATERIALS])

    def begin(self, part: ScenePart, *which: int) -> None:
        """In a staged scene what a part draws must not depend on what was drawn before it: furniture, for one.

        Args:
            part: what is drawn next.
            which: number of the room or opening, if there are several.
        """
        if self.is_staged:
            for stream, number in ((self.shapes, ()), (self.materials, (ScenePart.MATERIALS,))):
                fresh = np.random.default_rng([self._seed, part, *which, *number])
                stream.bit_generator.state = fresh.bit_generator.state
