"""Pinned albums: the photographs of a folder with their pins, as plain data and as read back from it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.album.pins import Album, Pin, PinPose, moved_pins
from lalaloc_core.photograph.placed_copy import Place

_VERSION = 1
_NOWHERE = dict.fromkeys(("plan", "room_id", "room", "position", "heading_deg"))


@dataclass(frozen=True, eq=False)
class PinnedPhotograph:
    """Photograph of an album.

    Attributes:
        number: number in the album, from 1.
        name: name of its file; empty for pictures without one.
        id: SHA-256 of its file; the same for copies of one file. None if it cannot be read, for `reason`.
        reason: why it cannot be read.
        taken: when it was taken, as text; empty if unknown.
        pin: its place; None if it cannot be read.
    """

    number: int
    name: str
    id: str | None
    reason: str = ""
    taken: str = ""
    pin: Pin | None = None

    def document(self) -> dict[str, Any]:
        """Return the photograph as plain data."""
        head = {"number": self.number, "photograph": self.name, "sha256": self.id, "taken": self.taken or None}
        if self.pin is None:
            shares = dict.fromkeys(("room_confidence", "confidence", "within_1m"), 0.0)
            return {**head, **_NOWHERE, **shares, "state": "set_aside", "reason": self.reason}
        fields = pin_document(self.pin)
        return {**head, **(fields.pop("place") or _NOWHERE), **fields}


@dataclass(frozen=True, eq=False, kw_only=True)
class PinnedAlbum:
    """Album of photographs that were solved together.

    Attributes:
        plan_ids: names of the plans in pins, which stay in the next revision.
        album: the solution: pins, cameras and their height, and scale.
        photographs: every photograph that was given, also those that cannot be read.
        notes: what was left out, and warnings about all photographs.
    """

    plans: Sequence[FloorPlan]
    plan_ids: Sequence[str]
    album: Album
    photographs: Sequence[PinnedPhotograph]
    notes: list[str] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return the album as plain data: `pins.json` of `lalaloc pin`."""
        counts = self.album.counts
        unread = sum(photograph.id is None for photograph in self.photographs)
        return {
            "version": _VERSION,
            "plans": [{"id": id, "name": plan.name} for id, plan in zip(self.plan_ids, self.plans, strict=True)],
            "counts": {**counts, "set_aside": counts["set_aside"] + unread},
            **common_document(self.album),
            "photographs": [photograph.document() for photograph in self.photographs],
            "notes": list(self.notes),
        }

    def moved_since(self, before: Sequence[Pin]) -> list[str]:
        """Return a sentence on each pin that moved by more than 0.5 m or changed its room."""
        names = {photograph.id: photograph.name for photograph in self.photographs}
        lines = []
        for moved in moved_pins(before, self.album.pins):
            old, new = ("set aside" if pose is None else f"in '{pose.room}'" for pose in (moved.before, moved.after))
            distance = "" if moved.distance_m is None else f", {moved.distance_m:.1f} m away"
            change = f"moved by {moved.distance_m:.1f} m {new}"
            if moved.new_room:
                change = f"was {old}, is now {new}{distance}"
            lines.append(f"'{names[moved.photograph_id]}' {change}")
        return lines or ["no pin moved by more than 0.5 m or changed its room"]


def pin_document(pin: Pin) -> dict[str, Any]:
    """Return a pin as plain data: its place, None if it is set aside, and how sure it is."""
    return {
        "place": None if pin.pose is None else _place(pin.pose),
        "state": pin.state,
        "room_confidence": _share(pin.confidence),
        # Its earlier name.
        "confidence": _share(pin.confidence),
        "within_1m": _share(pin.within_1m),
        "reason": pin.reason,
        "rooms": [
            {"plan": room.plan_id, "room_id": room.room_id, "room": room.room, "probability": _share(room.probability)}
            for room in pin.rooms
        ],
        "suggestions": [{**_place(row.pose), "probability": _share(row.probability)} for row in pin.suggestions],
        "warnings": list(pin.warnings),
    }


def stated_place(entry: Mapping[str, Any], plan: FloorPlan, anchor: Anchor | None) -> Place:
    """Return the place of an entry of `pins.json`, as files state it; `anchor` can be that of the plan's venue."""
    room, position, heading_deg = entry["room"], entry["position"], entry["heading_deg"]
    latitude = longitude = direction_deg = None
    if anchor is not None:
        latitude, longitude, direction_deg = anchor.place((position["x_m"], position["y_m"]), heading_deg)
    elif plan.north is not None and heading_deg is not None:
        direction_deg = (heading_deg - math.degrees(plan.north)) % 360.0
    return Place(room=room, level=plan.name, latitude=latitude, longitude=longitude, direction_deg=direction_deg)


def common_document(album: Album) -> dict[str, Any]:
    """Return what the photographs of an album have in common as plain data."""
    return {
        "cameras": [
            {
                "make": camera.make,
                "model": camera.model,
                "width": camera.width,
                "height": camera.height,
                "photographs": camera.photographs,
                "hfov_deg": math.degrees(camera.hfov),
                "hfov_std_deg": math.degrees(camera.hfov_sd),
            }
            for camera in album.cameras
        ],
        "camera_height_m": album.camera_height_m,
        "scale": album.scale,
        "compass_bias_deg": None if album.compass_bias is None else math.degrees(album.compass_bias),
    }


def _place(pose: PinPose) -> dict[str, Any]:
    return {
        "plan": pose.plan_id,
        "room_id": pose.room_id,
        "room": pose.room,
        "position": {"x_m": pose.x_m, "y_m": pose.y_m},
        "heading_deg": pose.heading_deg,
    }


def _share(value: float) -> float:
    # Sums of shares can exceed 1 by rounding.
    return min(max(value, 0.0), 1.0)


def read_pins(path: str | PathLike[str]) -> list[Pin]:
    """Read the pins of an earlier album from its `pins.json`.

    Raises:
        InvalidInputError: the file cannot be read, or is no such file.
    """
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        return [_pin_of(entry) for entry in document["photographs"] if entry["sha256"] is not None]
    except OSError as error:
        raise InvalidInputError(f"'{path}' cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InvalidInputError(f"'{path}' is not the pins.json of an earlier `lalaloc pin`") from error


def _pin_of(entry: dict[str, Any]) -> Pin:
    pose = None
    if entry["room"] is not None:
        heading = entry["heading_deg"]
        pose = PinPose(
            plan_id=str(entry["plan"]),
            room_id=str(entry["room_id"]),
            room=str(entry["room"]),
            x_m=float(entry["position"]["x_m"]),
            y_m=float(entry["position"]["y_m"]),
            heading=None if heading is None else math.radians(heading),
        )
    state, confidence = entry["state"], float(entry["confidence"])
    return Pin(photograph_id=str(entry["sha256"]), state=state, pose=pose, confidence=confidence, within_1m=0.0)
