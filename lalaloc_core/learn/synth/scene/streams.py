"""Random streams of a scene: one for shapes, one for materials."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class ScenePart(IntEnum):
    """Parts of a scene that have streams of their own in a staged scene."""

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
    """Random streams of one scene; with `is_staged` every part restarts its stream, see `begin`.

    Attributes:
        shapes: decides everything except materials.
        materials: separate, because shapes must not depend on the available pictures.
    """

    def __init__(self, seed: int, *, is_staged: bool) -> None:
        self._seed, self.is_staged = seed, is_staged
        self.shapes = np.random.default_rng(seed)
        self.materials = np.random.default_rng([seed, ScenePart.MATERIALS])

    def begin(self, part: ScenePart, *which: int) -> None:
        """Restart the streams for a part, so that in a staged scene it does not depend on the parts before it.

        `which` numbers the room or opening, if there are several.
        """
        if self.is_staged:
            for stream, number in ((self.shapes, ()), (self.materials, (ScenePart.MATERIALS,))):
                fresh = np.random.default_rng([self._seed, part, *which, *number])
                stream.bit_generator.state = fresh.bit_generator.state
