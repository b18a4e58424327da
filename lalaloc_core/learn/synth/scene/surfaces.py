"""Appearance of surfaces: rows of a table with picture, scale, rotation, tint, gloss and glow; style of a house."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.learn.synth.furniture.pieces import Finish
from lalaloc_core.learn.synth.records import Column, Records, Row, columns
from lalaloc_core.learn.synth.scene.materials import MaterialCategory, MaterialLibrary

Colour = Float[np.ndarray, "3"]

_WOODY: tuple[Finish, ...] = ("wood", "stone")
_PLAIN_FINISHES: tuple[Finish, ...] = ("white", "metal", "dark", "ceramic", "glow", "paint")


class Surfaces(Records):
    """Appearance of the surfaces of a scene.

    Attributes:
        gloss: share of light reflected like a mirror.
        glow: if positive, the surface emits its colour times this instead of reflecting light.
        is_outdoors: 1 for the view through a window.
        shift_u, shift_v: translation of the picture, as shares of it.
    """

    picture, scale, cosine, sine = columns(4)
    tint = Column(3)
    gloss, glow, is_outdoors, shift_u, shift_v = columns(5)


class SurfaceTable:
    """Table of the surfaces of one scene; every method returns the index of the row it added."""

    def __init__(self, materials: MaterialLibrary, rng: np.random.Generator) -> None:
        self._materials, self._rng = materials, rng
        self.rows: list[Row] = []

    def add(
        self,
        category: MaterialCategory,
        colour: Colour | None = None,
        *,
        scale: float = 1.0,
        angle: float = 0.0,
        gloss: float = 0.0,
        glow: float = 0.0,
    ) -> int:
        """Add a surface with a random picture of a category, tinted to a mean `colour` if one is given.

        Without `colour` (linear) the picture keeps its own, varied a little. `scale` is in pictures per metre, `angle`
        in radians, and `gloss` the share of light reflected like a mirror. With a positive `glow` the surface emits its
        colour times this instead of reflecting light.
        """
        picture = self._materials.sample(category, self._rng)
        if colour is None:
            tint = np.exp(self._rng.normal(0.0, 0.2)) * np.exp(self._rng.normal(0.0, 0.04, 3))
        else:
            tint = colour / self._materials.mean_colours[picture]
        return self._append(picture, tint, angle, scale=scale, gloss=gloss, glow=glow)

    def add_plain(self, colour: Colour, *, gloss: float = 0.0, glow: float = 0.0) -> int:
        """Add a surface of one colour; see `add`."""
        plain = self._materials.plain
        picture = int(plain[self._rng.integers(len(plain))])
        tint = colour / self._materials.mean_colours[picture]
        return self._append(picture, tint, 0.0, scale=0.5, gloss=gloss, glow=glow)

    def _append(self, picture: int, tint: Colour, angle: float, **columns: float) -> int:
        shift_u, shift_v = self._rng.random(2)
        columns |= {"cosine": math.cos(angle), "sine": math.sin(angle), "shift_u": shift_u, "shift_v": shift_v}
        self.rows.append(Surfaces.row(picture=picture, tint=tint, **columns))
        return len(self.rows) - 1

    def add_outdoors(self, glow: float) -> int:
        """Add the view through a window."""
        self.rows.append(Surfaces.row(scale=1.0, cosine=1.0, tint=1.0, glow=glow, is_outdoors=1.0))
        return len(self.rows) - 1

    def darken_outdoors(self, index: int) -> None:
        """Make the view through a window that of the night."""
        Surfaces(self.rows[index]).glow = math.exp(self._rng.uniform(math.log(0.004), math.log(0.12)))

    def add_floor(self, walls: Colour, direction: float, *, plain: bool = False) -> int:
        """Add a floor along `direction` (radians): mostly with a picture's own colours, sometimes like the walls.

        A `plain` one is wooden, beige or grey.
        """
        colour = walls * self._rng.uniform(0.8, 1.1) if self._rng.random() < 0.08 else None
        if plain and self._rng.random() < 0.7:
            neutral = pale(self._rng) * self._rng.uniform(0.4, 0.9)
            colour = neutral if self._rng.random() < 0.5 else 1.5 * wood_tone(self._rng)
        gloss = self._rng.uniform(0.05, 0.35) if self._rng.random() < 0.5 else 0.0
        angle = -direction + 0.5 * math.pi * int(self._rng.integers(2))
        if self._rng.random() < 0.1:
            angle += self._rng.uniform(0.0, math.pi)
        return self.add("floor", colour, scale=math.exp(self._rng.uniform(-0.9, 0.6)), angle=angle, gloss=gloss)

    def add_wall(self, colour: Colour) -> int:
        """Add a wall: painted, or with a picture's own colours."""
        kind = self._rng.random()
        if kind < 0.68:
            return self.add_plain(colour)
        return self.add("wall", None if kind > 0.9 else colour, scale=math.exp(self._rng.uniform(-0.7, 0.7)))

    def add_ceiling(self, colour: Colour) -> int:
        """Add a ceiling: mostly painted, sometimes panelled."""
        if self._rng.random() < 0.8:
            return self.add_plain(colour)
        return self.add("ceiling", colour, scale=self._rng.uniform(0.4, 1.2))

    def add_finish(self, finish: Finish) -> int:
        """Add a surface of furniture."""
        colour, gloss, glow = _finish(finish, self._rng)
        if colour is not None and finish in _PLAIN_FINISHES:
            return self.add_plain(colour, gloss=gloss, glow=glow)
        angle = 0.5 * math.pi * int(self._rng.integers(2)) if finish in _WOODY else 0.0
        return self.add(
            "furniture", colour, scale=math.exp(self._rng.uniform(-0.3, 1.2)), angle=angle, gloss=gloss, glow=glow
        )


def paint(rng: np.random.Generator) -> Colour:
    """Draw a wall paint: mostly near white, sometimes coloured or dark."""
    kind = rng.random()
    if kind < 0.62:
        level, strength = rng.uniform(0.5, 0.88), 0.06
    elif kind < 0.85:
        level, strength = rng.uniform(0.2, 0.6), 0.18
    else:
        level, strength = rng.uniform(0.03, 0.3), 0.45
    warm, green = rng.normal(0.25, 0.7) * strength, rng.normal(0.0, 0.5) * strength
    return np.clip(level * np.array([1.0 + warm, 1.0 + green, 1.0 - warm]), 0.01, 0.92)


def pale(rng: np.random.Generator) -> Colour:
    """Draw white, beige or light grey, as in a home for sale."""
    warm = rng.uniform(-0.01, 0.09)
    return rng.uniform(0.5, 0.88) * np.array([1.0 + 0.5 * warm, 1.0, 1.0 - warm])


def bright(rng: np.random.Generator) -> Colour:
    """Draw the white of painted ceilings, trims and doors."""
    return rng.uniform(0.55, 0.9) * np.array([1.0, 1.0 - rng.uniform(0, 0.03), 1.0 - rng.uniform(0, 0.08)])


def wood_tone(rng: np.random.Generator) -> Colour:
    """Draw a brown, from ebony to birch."""
    level, warmth = math.exp(rng.uniform(math.log(0.03), math.log(0.45))), rng.uniform(0.1, 0.5)
    return level * np.array([1.0 + warmth, 1.0, 1.0 - warmth])


def vivid(rng: np.random.Generator) -> Colour:
    """Draw any colour."""
    return math.exp(rng.uniform(math.log(0.05), math.log(0.6))) * np.clip(1.0 + rng.normal(0.0, 0.45, 3), 0.1, 2.0)


def _finish(finish: Finish, rng: np.random.Generator) -> tuple[Colour | None, float, float]:
    """Return (mean colour, gloss, glow)."""
    if finish == "wood":
        return (wood_tone(rng) if rng.random() < 0.6 else None), 0.0, 0.0
    if finish == "fabric":
        return (np.clip(paint(rng) * rng.uniform(0.2, 1.0), 0.02, 0.9) if rng.random() < 0.7 else None), 0.0, 0.0
    if finish == "white":
        return bright(rng), 0.02, 0.0
    if finish == "metal":
        return rng.uniform(0.15, 0.6) * np.array([1.0, 1.0, 1.02]), 0.2, 0.0
    if finish == "dark":
        return rng.uniform(0.01, 0.06) * np.ones(3), 0.05, 0.0
    if finish == "leaf":
        return rng.uniform(0.04, 0.2) * np.array([rng.uniform(0.4, 0.9), 1.0, rng.uniform(0.1, 0.5)]), 0.0, 0.0
    if finish == "ceramic":
        return bright(rng) * (1.0 if rng.random() < 0.85 else 0.3), 0.08, 0.0
    if finish == "stone":
        return (paint(rng) if rng.random() < 0.5 else None), 0.08, 0.0
    if finish == "glow":
        return np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.55, 1.0)]), 0.0, rng.uniform(0.8, 4.0)
    if finish == "paint":
        return paint(rng), 0.02, 0.0
    return vivid(rng), 0.0, 0.0


@dataclass(frozen=True, kw_only=True)
class HouseStyle:
    """One style for all rooms of a scene: rows of its surfaces, and heights of baseboards and mouldings, 0 for none."""

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
