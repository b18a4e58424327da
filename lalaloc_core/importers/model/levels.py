"""Which storeys of a file become plans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.sketch import Level

T = TypeVar("T")
_MAX_NAMED = 12


def chosen_levels(levels: Mapping[str, tuple[Level, T]], options: ImportOptions) -> list[tuple[Level, T]]:
    """All storeys, lowest first, or the one that the options name.

    Raises:
        InvalidFloorPlanError: no storey of that name or number.
    """
    ordered = sorted(levels.values(), key=lambda item: _height(item[0]))
    if options.level is None:
        return ordered
    found = [item for item in ordered if item[0].answers_to(options.level)]
    if not found:
        known = ", ".join(f"'{level.name}'" for level, _ in ordered[:_MAX_NAMED])
        raise InvalidFloorPlanError(f"the file has no level '{options.level}', it has {known}")
    return found


def _height(level: Level) -> float:
    if level.elevation_m is not None:
        return level.elevation_m
    return level.number if level.number is not None else 0.0
