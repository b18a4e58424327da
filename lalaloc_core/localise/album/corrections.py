"""Corrections of pins: statements of a person, which are certain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, InvalidCorrectionError

CorrectionKind = Literal["room", "position", "elsewhere", "confirmed"]


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A statement about the place of one photograph.

    Attributes:
        kind: "room": the camera is in a room, at an unknown place of it; "position": at a place, and with a heading if
            one is given; "elsewhere": in none of the rooms; "confirmed": where the pin was, as "position".
        plan_id: the plan of the room or the position.
        room_id: the room, for "room".
        x_m, y_m: the position, in the frame of the plan.
        heading_deg: heading, degrees clockwise from the plan's +y; None for an unknown one.
    """

    kind: CorrectionKind
    plan_id: str | None = None
    room_id: str | None = None
    x_m: float | None = None
    y_m: float | None = None
    heading_deg: float | None = None

    def __post_init__(self) -> None:
        given = {name for name, value in asdict(self).items() if value is not None} - {"kind"}
        needed = _FIELDS[self.kind]
        missing, foreign = needed - given, given - needed - _OPTIONAL[self.kind]
        if missing:
            raise InvalidCorrectionError(f"the correction '{self.kind}' needs {', '.join(sorted(missing))}")
        if foreign:
            raise InvalidCorrectionError(f"{', '.join(sorted(foreign))} does not go with the correction '{self.kind}'")
        for name, limit in (("x_m", _MAX_M), ("y_m", _MAX_M), ("heading_deg", _MAX_DEG)):
            value = getattr(self, name)
            # NaN is in no range.
            if value is not None and not abs(value) <= limit:
                raise InvalidCorrectionError(f"{name} is {value:g}; it must be between -{limit:g} and {limit:g}")

    def to_document(self) -> dict[str, Any]:
        """Return the correction as JSON."""
        return {name: value for name, value in asdict(self).items() if value is not None}


_MAX_M, _MAX_DEG = 1e5, 360.0
_PLACE = frozenset({"plan_id", "x_m", "y_m"})
_FIELDS: Mapping[str, frozenset[str]] = {
    "room": frozenset({"plan_id", "room_id"}),
    "position": _PLACE,
    "elsewhere": frozenset(),
    "confirmed": _PLACE,
}
_OPTIONAL: Mapping[str, frozenset[str]] = dict.fromkeys(get_args(CorrectionKind), frozenset()) | {
    "position": frozenset({"heading_deg"}),
    "confirmed": frozenset({"heading_deg"}),
}


def read_correction(document: object) -> Correction:
    """Read a correction that `to_document` wrote."""
    try:
        return build_config(Correction, document, path="correction")
    except (ConfigError, ValueError) as error:
        raise InvalidCorrectionError(str(error)[:300]) from error
