"""True poses of the example photographs in `poses.json`, written by `make_examples.py`."""

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
    """True pose of one photograph, with the fields of the file; `heading_deg` is that of the centre column."""

    file: str
    plan: str
    room: str
    x_m: float
    y_m: float
    heading_deg: float
    camera_height_m: float

    @property
    def picture(self) -> Path:
        return FOLDER / self.file


def read_poses() -> list[TruePose]:
    return [TruePose(**record) for record in json.loads(POSES_PATH.read_bytes())]


def write_poses(poses: Sequence[TruePose]) -> None:
    records = [dataclasses.asdict(pose) for pose in poses]
    POSES_PATH.write_text(json.dumps(records, indent=2) + "\n", encoding="utf-8")
