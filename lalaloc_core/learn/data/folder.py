"""A user's own data, and the out-of-distribution homes: plans in the native format, spheres, a table of their poses.

    ROOT/<scene>/plan.json      floor plan (docs/reference/plan-format.md)
    ROOT/<scene>/poses.csv      photograph,x_m,y_m,heading_deg,camera_height_m
    ROOT/<scene>/...            photographs, named in poses.csv by their path below the scene's folder
    ROOT/splits.csv             scene,split; without it every scene is a test scene

The column `camera_height_m` and its cells are optional; the default is the plan's camera height.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import DatasetError, InvalidFloorPlanError, InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.assembly import path_below, pose_fault
from lalaloc_core.learn.data.dataset import Appearance, Camera, FilePhotograph, Scene, Split, collect_error
from lalaloc_core.learn.dataset_names import HELDOUT_HOMES, SPLITS

PLAN_FILE = "plan.json"
POSES_FILE = "poses.csv"
SPLITS_FILE = "splits.csv"

_REQUIRED = ("photograph", "x_m", "y_m", "heading_deg")
_OPTIONAL = ("camera_height_m",)
_EARLIER_COLUMNS = {"panorama": "photograph"}
# Larger coordinates indicate another unit.
_MAX_COORDINATE_M = 100_000.0


@dataclass(frozen=True)
class OwnData:
    """Folder of a user's own scenes."""

    root: Path

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"own data ({self.root.resolve().name})"

    appearances = (Appearance(),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes in order."""
        return [name for name, scene_split in self._splits.items() if scene_split == split]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read a scene; see `Dataset.load`."""
        folder = path_below(self.root, name)
        if folder is None or not (folder / PLAN_FILE).is_file():
            raise DatasetError(f"unknown scene: {PLAN_FILE} is missing", scene=name, path=self.root / PLAN_FILE)
        plan = _read_plan(folder / PLAN_FILE, name)
        cameras: dict[str, Camera] = {}
        for row in _read_table(folder / POSES_FILE, _REQUIRED, _OPTIONAL, scene=name):
            with collect_error(problems):
                camera = _camera(row, plan, folder)
                if camera.name in cameras:
                    raise row.error("photograph", "it is a duplicate of an earlier line")
                cameras[camera.name] = camera
        return Scene(name=name, plan=plan, cameras=tuple(cameras.values()))

    @cached_property
    def _splits(self) -> dict[str, Split]:
        names = sorted(path.parent.name for path in self.root.glob(f"*/{PLAN_FILE}"))
        path = self.root / SPLITS_FILE
        if not path.exists():
            return dict.fromkeys(names, "test")
        found: dict[str, Split] = {}
        for row in _read_table(path, ("scene", "split"), (), scene=None):
            scene, split = row.cells["scene"], row.cells["split"]
            if split not in SPLITS:
                raise row.error("split", f"it must be one of {', '.join(SPLITS)}")
            if scene not in names:
                raise row.error("scene", f"no folder of this name has a {PLAN_FILE}")
            if scene in found:
                raise row.error("scene", "it is a duplicate of an earlier line")
            found[scene] = split  # type: ignore[assignment]
        missing = [name for name in names if name not in found]
        if missing:
            raise DatasetError("the scene has no line in this table", scene=missing[0], path=path)
        return {name: found[name] for name in names}


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One line of a table."""

    path: Path
    scene: str | None
    line: int
    cells: Mapping[str, str]

    def number(self, column: str, low: float, high: float) -> float:
        """Return a cell as a number from `low` to `high`."""
        try:
            value = float(self.cells[column])
        except ValueError:
            raise self.error(column, "it must be a number") from None
        if not math.isfinite(value) or not low <= value <= high:
            raise self.error(column, f"it must lie between {low:g} and {high:g}")
        return value

    def error(self, column: str, reason: str) -> DatasetError:
        """Create an error with the line, column and value, and the photograph if the table has one."""
        shown = f"line {self.line}, column '{column}' is '{self.cells[column][:80]}': {reason}"
        return DatasetError(shown, scene=self.scene, room=self.cells.get("photograph") or None, path=self.path)


def _camera(row: _Row, plan: FloorPlan, folder: Path) -> Camera:
    photograph = row.cells["photograph"]
    path = path_below(folder, photograph)
    if path is None:
        raise row.error("photograph", "it must be a path below the scene's folder")
    if not path.is_file():
        raise row.error("photograph", "the file does not exist")
    x_m = row.number("x_m", -_MAX_COORDINATE_M, _MAX_COORDINATE_M)
    y_m = row.number("y_m", -_MAX_COORDINATE_M, _MAX_COORDINATE_M)
    heading_deg = row.number("heading_deg", -360.0, 360.0)
    height_m = plan.camera_height_m
    if row.cells.get("camera_height_m"):
        height_m = row.number("camera_height_m", 0.0, float(plan.ceiling_heights_m.max()))
    position_m = np.array([x_m, y_m])
    room_index = int(plan.room_index_at(position_m[None])[0])
    if room_index < 0:
        away_m, nearest = min((float(room.shape.distance(shapely.Point(position_m))), room.name) for room in plan.rooms)
        raise row.error("x_m", f"({x_m:g}, {y_m:g}) m is in no room; the nearest is '{nearest}', {away_m:.3g} m away")
    fault = pose_fault(plan, room_index, position_m, height_m)
    if fault is not None:
        raise row.error("camera_height_m" if row.cells.get("camera_height_m") else "photograph", fault)
    return Camera(
        name=photograph,
        position_m=position_m,
        room_index=room_index,
        heading=heading_from_degrees(heading_deg),
        camera_height_m=height_m,
        photographs={Appearance(): FilePhotograph(path=path, scene=row.scene or "", room=photograph)},
    )


def _read_plan(path: Path, scene: str) -> FloorPlan:
    try:
        return FloorPlan.from_json(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"cannot be read: {error.strerror}", scene=scene, path=path) from error
    except InvalidFloorPlanError as error:
        raise DatasetError(error.reason, scene=scene, room=error.room, path=path) from error


def _read_table(path: Path, required: Sequence[str], optional: Sequence[str], *, scene: str | None) -> Iterator[_Row]:
    """Yield the lines of a CSV file with a header, without empty lines."""
    try:
        # Spreadsheets write a byte order mark.
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DatasetError(f"cannot be read: {error.strerror}", scene=scene, path=path) from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"not UTF-8 text: {error}", scene=scene, path=path) from error
    lines = csv.reader(text.splitlines(), strict=True)
    try:
        header = [_EARLIER_COLUMNS.get(cell.strip(), cell.strip()) for cell in next(lines, [])]
        wrong = [name for name in header if name not in (*required, *optional)]
        missing = [name for name in required if name not in header]
        if wrong or missing or len(set(header)) < len(header):
            raise DatasetError(
                f"line 1 is '{','.join(header)[:200]}'; it must name the columns {','.join((*required, *optional))}"
                + (f" ({', '.join(optional)} is optional)" if optional else ""),
                scene=scene,
                path=path,
            )
        for cells in lines:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                raise DatasetError(
                    f"line {lines.line_num} has {len(cells)} cells; the header has {len(header)}",
                    scene=scene,
                    path=path,
                )
            stripped = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
            yield _Row(path=path, scene=scene, line=lines.line_num, cells=stripped)
    except csv.Error as error:
        raise DatasetError(f"line {lines.line_num} is not valid CSV: {error}", scene=scene, path=path) from error


_FOLDER = Path(__file__).resolve().parents[3] / "datasets" / "heldout"


@dataclass(frozen=True, kw_only=True)
class HeldoutScenes:
    """The first of the sixty homes, furnished, with four spheres each. All are test homes."""

    homes: int = HELDOUT_HOMES

    def __post_init__(self) -> None:
        if not 1 <= self.homes <= HELDOUT_HOMES:
            raise InvalidInputError(f"homes is {self.homes}; there are {HELDOUT_HOMES} out-of-distribution homes")
        if not _FOLDER.is_dir():
            raise DatasetError("out-of-distribution homes are in the repository, not in installations", path=_FOLDER)

    description = "out-of-distribution homes"
    appearances = (Appearance("full"),)

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of the homes."""
        return self._folder.scenes(split)[: self.homes]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Read a home; its cameras are named by number."""
        scene = self._folder.load(name, problems)
        cameras = (
            dataclasses.replace(
                camera,
                name=Path(camera.name).stem,
                photographs=dict.fromkeys(self.appearances, *camera.photographs.values()),
            )
            for camera in scene.cameras
        )
        return dataclasses.replace(scene, cameras=tuple(cameras))

    @property
    def _folder(self) -> OwnData:
        return OwnData(_FOLDER)
