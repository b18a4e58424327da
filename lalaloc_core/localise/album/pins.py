"""Pins: the places of an album's photographs, with everything that was found on the way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from lalaloc_core.conventions import heading_to_degrees

PinState = Literal["sure", "uncertain", "set_aside", "corrected"]
# A pin moved if it did by more (m), or changed its room.
_MOVED_M = 0.5


@dataclass(frozen=True, kw_only=True)
class PinPose:
    """A place in a plan, and the azimuth of the photograph's centre (radians); None where that is unknown.

    Attributes:
        plan_id, room_id, room: the plan, and the id and name of the room in it.
        x_m, y_m: position in the frame of that plan.
    """

    plan_id: str
    room_id: str
    room: str
    x_m: float
    y_m: float
    heading: float | None

    @property
    def heading_deg(self) -> float | None:
        """Heading in degrees clockwise from the plan's +y."""
        return None if self.heading is None else heading_to_degrees(self.heading)


@dataclass(frozen=True, kw_only=True)
class RoomShare:
    """Probability of a room."""

    plan_id: str
    room_id: str
    room: str
    probability: float


@dataclass(frozen=True, kw_only=True)
class Suggestion:
    """A pose that the photograph can have been taken at, and its probability."""

    pose: PinPose
    probability: float


@dataclass(frozen=True, kw_only=True)
class Pin:
    """The place of one photograph.

    Attributes:
        state: "sure": the room is probably right (`confidence` at least `solve.SURE`), and the album fits its plan;
            "uncertain": less so;
            "set_aside": of none of the rooms, or not usable, for `reason`; "corrected": a person stated it.
        pose: the place; None if it is set aside.
        confidence: probability that the room is right; 1 if it was stated.
        within_1m: probability that the pose is right within 1 m.
        elsewhere: probability that it is of none of the rooms.
        reason: a sentence on why it is set aside or uncertain; empty otherwise.
        rooms: the probable rooms, most probable first.
        suggestions: up to five distinct poses, most probable first; the first is `pose`, if the pin has one.
        warnings: what was assumed or left out.
    """

    photograph_id: str
    state: PinState
    pose: PinPose | None
    confidence: float
    within_1m: float
    elsewhere: float = 0.0
    reason: str = ""
    rooms: tuple[RoomShare, ...] = ()
    suggestions: tuple[Suggestion, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SharedCamera:
    """A camera of the album: photographs of one maker, model and size share their field of view.

    Attributes:
        make, model, width, height: as in its photographs; the width is the longer side, pixels.
        hfov: horizontal field of view, radians.
        hfov_sd: its standard deviation; 0 if every photograph states it.
    """

    make: str
    model: str
    width: int
    height: int
    photographs: int
    hfov: float
    hfov_sd: float


@dataclass(frozen=True, kw_only=True)
class Album:
    """Result of a solve.

    Attributes:
        pins: a pin for every photograph, in the order in which they were given.
        cameras: the cameras and their fields of view.
        camera_height_m: height of the cameras over the floor; None without photographs.
        scale: factor of the plan's lengths that fits the photographs best.
        compass_bias: azimuth of the compass's north in the plan minus that of true north, radians; the azimuth itself
            if the plan does not state north. None without photographs that have a compass heading.
        misread: share of photographs whose walls and openings fit the plan no better than other homes.
        warnings: what was assumed or dropped for all photographs.
    """

    pins: tuple[Pin, ...]
    cameras: tuple[SharedCamera, ...] = ()
    camera_height_m: float | None = None
    scale: float = 1.0
    compass_bias: float | None = None
    misread: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[PinState, int]:
        """Number of pins by state."""
        states: tuple[PinState, ...] = ("sure", "uncertain", "set_aside", "corrected")
        return {state: sum(pin.state == state for pin in self.pins) for state in states}


@dataclass(frozen=True, kw_only=True)
class MovedPin:
    """A pin that changed between two solves; `before` or `after` is None where it was set aside.

    Attributes:
        distance_m: how far it moved; None between plans, or if it was set aside.
        new_room: whether its room is another.
    """

    photograph_id: str
    before: PinPose | None
    after: PinPose | None
    distance_m: float | None
    new_room: bool


def moved_pins(before: Sequence[Pin], after: Sequence[Pin]) -> list[MovedPin]:
    """Return the pins, in the order of `after`, that moved by more than 0.5 m or changed their room.

    Photographs that are in one of the two only are left out.
    """
    known = {pin.photograph_id: pin.pose for pin in before}
    changes = [
        moved_pin(pin.photograph_id, known[pin.photograph_id], pin.pose) for pin in after if pin.photograph_id in known
    ]
    return [change for change in changes if change is not None]


def moved_pin(photograph_id: str, before: PinPose | None, after: PinPose | None) -> MovedPin | None:
    """Return the change of a pin; None if it moved by at most 0.5 m in its room."""
    distance_m, new_room = None, before is not after
    if before is not None and after is not None:
        same_plan = before.plan_id == after.plan_id
        distance_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) if same_plan else None
        new_room = not same_plan or before.room_id != after.room_id
    if not new_room and (distance_m is None or distance_m <= _MOVED_M):
        return None
    return MovedPin(photograph_id=photograph_id, before=before, after=after, distance_m=distance_m, new_room=new_room)
