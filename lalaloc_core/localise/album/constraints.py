"""Corrections in the frame of an album's ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidCorrectionError
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.ground import AlbumGround


@dataclass(frozen=True, eq=False)
class Constraint:
    """A stated place.

    Attributes:
        room: number of the room; None for none of the rooms.
        position_m: the position in the frame of the ground's plan; None where only the room is known.
        heading: heading, radians; None if it is not stated.
    """

    room: int | None
    position_m: Float[np.ndarray, "2"] | None = None
    heading: float | None = None


def constraint_of(ground: AlbumGround, photograph: AlbumPhotograph) -> Constraint:
    """Return the constraint of a photograph's correction."""
    stated = photograph.correction
    assert stated is not None
    if stated.kind == "elsewhere":
        return Constraint(None)
    assert stated.plan_id is not None
    if stated.kind == "room":
        assert stated.room_id is not None
        room = ground.room_of(stated.plan_id, stated.room_id)
        if room is None:
            raise InvalidCorrectionError(
                f"photograph '{photograph.id:.50}' is corrected to room '{stated.room_id:.50}' of plan "
                f"'{stated.plan_id:.50}', which does not exist; state another room, or undo the correction"
            )
        return Constraint(room)
    assert stated.x_m is not None
    assert stated.y_m is not None
    found = ground.position_of(stated.plan_id, stated.x_m, stated.y_m)
    if found is None:
        raise InvalidCorrectionError(
            f"photograph '{photograph.id:.50}' is corrected to a position in plan '{stated.plan_id:.50}', which does "
            "not exist or has no room; state another one, or undo the correction"
        )
    heading = None if stated.heading_deg is None else heading_from_degrees(stated.heading_deg)
    return Constraint(found[1], found[0], heading)
