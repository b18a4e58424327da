"""Where the example panoramas were taken: `poses.json`, written by `make_examples`, read by the demo."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PLAN_PATH = FOLDER / "flat.json"
POSES_PATH = FOLDER / "poses.json"


@dataclass(frozen=True, kw_only=True)
class TruePose:
    """True pose of one panorama; the fields are those of the file.

    Attributes:
        file: name of the picture in this folder.
        plan: name of the plan's file in this folder.
        room: name of the room.
        x_m, y_m: position in the plan frame.
        heading_deg: azimuth of the picture's centre column.
        camera_height_m: over the floor.
    """

    file: str
    plan: str
    room: str
    x_m: float
    y_m: float
    heading_deg: float
    camera_height_m: float

    @property
    def picture(self) -> Path:
        """The picture's path."""
        return FOLDER / self.file


def read_poses() -> list[TruePose]:
    """The true poses of all example panoramas."""
    return [TruePose(**record) for record in json.loads(POSES_PATH.read_bytes())]


def write_poses(poses: Sequence[TruePose]) -> None:
    """Replace the file."""
    records = [dataclasses.asdict(pose) for pose in poses]
    POSES_PATH.write_text(json.dumps(records, indent=2) + "\n", encoding="utf-8")
