"""Trace of an import: what was read from a drawing, for a picture of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from shapely.geometry.base import BaseGeometry

TracePart = Literal["line", "wall line", "door", "window", "passage", "other", "wall", "gap", "room", "no room"]
# Further shapes are left out: a picture would not show them.
_MAX_SHAPES = 100_000


@dataclass
class Trace:
    """Shapes of a drawing in metres, y up, with what they were taken for."""

    shapes: list[tuple[TracePart, BaseGeometry]] = field(default_factory=list)

    def add(self, part: TracePart, shapes: Iterable[BaseGeometry]) -> None:
        """Add shapes of one kind."""
        for shape in shapes:
            if len(self.shapes) < _MAX_SHAPES and not shape.is_empty:
                self.shapes.append((part, shape))
