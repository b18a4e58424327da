"""Drawing of a room as the image encoder sees it: the most that features reveal of a photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, TWO_PI, column_azimuths
from lalaloc_core.draw.canvas import INK, MUTED, ON_PAPER, document, path, words
from lalaloc_core.localise.query import Query

_SIZE, _PAD, _FOOT = 800.0, 40.0, 150.0
# Runs of an opening that are narrower are noise.
_MIN_COLUMNS = 2


@dataclass(frozen=True, eq=False)
class SeenRoom:
    """Room around a camera, as predicted from one photograph; azimuths are relative to the photograph's centre.

    Attributes:
        azimuth: (w,) azimuths (radians).
        distance_m: (w,) most probable distance of the wall.
        seen: (w,) azimuths that the photograph shows.
        kind: (w,) most probable opening class, as in `conventions.OPENING_CLASSES`.
        ceiling_m: height of the ceiling above the floor.
        types: probabilities of the room types, the most probable first.
    """

    azimuth: Float[np.ndarray, "w"]
    distance_m: Float[np.ndarray, "w"]
    seen: Bool[np.ndarray, "w"]
    kind: Int[np.ndarray, "w"]
    ceiling_m: float
    types: dict[str, float]

    def document(self) -> dict[str, Any]:
        """Return the room as JSON, angles in degrees."""
        return {
            "room_types": {name: round(share, 3) for name, share in self.types.items()},
            "ceiling_height_m": round(self.ceiling_m, 2),
            "walls": [
                {"azimuth_deg": round(math.degrees(azimuth), 2), "distance_m": round(distance_m, 2)}
                for azimuth, distance_m in zip(
                    self.azimuth[self.seen].tolist(), self.distance_m[self.seen].tolist(), strict=True
                )
            ],
            "openings": [
                {"kind": OPENING_CLASSES[self.kind[run[0]]], "from_deg": ends[0], "to_deg": ends[1]}
                for run in self.openings
                for ends in [np.degrees(self.azimuth[[run[0], run[-1]]]).round(2).tolist()]
            ],
        }

    @property
    def openings(self) -> list[Int[np.ndarray, "n"]]:
        """Columns of each opening, from left to right."""
        codes = np.where(self.seen, self.kind, 0)
        runs = np.split(np.arange(len(codes)), np.flatnonzero(np.diff(codes)) + 1)
        return [run for run in runs if codes[run[0]] and len(run) >= _MIN_COLUMNS]


def seen_room(query: Query) -> SeenRoom:
    """Return the room that was predicted from a photograph with an unknown heading."""
    profile, openings, ceiling, types = query.profile, query.openings, query.ceiling, query.room_type
    if query.objects is not None:
        types = query.objects.room_type
    assert profile is not None
    assert openings is not None
    assert ceiling is not None
    assert types is not None
    return SeenRoom(
        azimuth=column_azimuths(profile.log_m.shape[1]),
        distance_m=np.exp(profile.log_m[0]).astype(np.float64),
        seen=profile.seen[0],
        kind=openings.log_probability[0].argmax(axis=1),
        ceiling_m=query.camera_height.height_m + math.exp(ceiling.log_m),
        types=types.shares(),
    )


def draw_seen_room(room: SeenRoom) -> str:
    """Draw the room from above, the photograph's centre at the top, as an SVG document."""
    scale = (0.5 * _SIZE - _PAD) / float(np.quantile(room.distance_m[room.seen], 0.98))
    half_column, centre = 0.5 * TWO_PI / len(room.azimuth), 0.5 * _SIZE
    parts = []
    for index in np.flatnonzero(room.seen):
        ends = room.azimuth[index] + np.array([-half_column, half_column])
        points = np.stack([np.sin(ends), -np.cos(ends)], axis=1) * room.distance_m[index] * scale + centre
        kind = OPENING_CLASSES[room.kind[index]]
        parts.append(f'<path d="{path([points])}" fill="none" stroke="{ON_PAPER[kind]}" stroke-width="6"/>')
    parts.append(f'<path d="M{centre} {centre - 16}l10 28h-20z" fill="{INK}"/>')
    types = ", ".join(f"{name} {100 * share:.0f} %" for name, share in room.types.items())
    parts.append(words(_PAD, _SIZE + 20, f"Room: {types}", 20))
    parts.append(words(_PAD, _SIZE + 52, f"Ceiling: {room.ceiling_m:.2f} m above the floor", 20))
    for number, kind in enumerate(OPENING_CLASSES):
        x = _PAD + 170 * number
        parts.append(f'<path d="M{x} {_SIZE + 84}h30" stroke="{ON_PAPER[kind]}" stroke-width="6"/>')
        parts.append(words(x + 40, _SIZE + 90, kind, 18, fill=MUTED))
    parts.append(f'<path d="M{_PAD} {_SIZE + 122}h{scale:.1f}" stroke="{INK}" stroke-width="2"/>')
    parts.append(words(_PAD + scale + 10, _SIZE + 128, "1 m", 16, fill=MUTED))
    return document(_SIZE, _SIZE + _FOOT, "Room by the features of a photograph", parts)
