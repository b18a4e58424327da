"""`lalaloc track`: follow a camera through a folder of photographs, without a service."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.cameras import add_camera_options, content_of, named, stated_camera, view_document
from lalaloc_core.cli.options import add_options, heading
from lalaloc_core.cli.plan_files import add_plan_options, check_picture_name, read_plan, write_picture, write_text
from lalaloc_core.cli.printing import JSON_DECIMALS, pose_cells, pose_document, print_json, print_table
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError

if TYPE_CHECKING:
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.tracking.tracking_filter import Tracked
    from lalaloc_core.localise.tracking.trajectories import Trajectory
    from lalaloc_core.photograph import StatedCamera

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic"})
_HEAD = ("photograph", "mode", "room", "x m", "y m", "heading °", "probability")


@dataclass(frozen=True, eq=False)
class _Found:
    """The answer for one photograph, and what was assumed about it."""

    path: Path
    time_s: float
    view: dict[str, Any]
    tracked: Tracked


@dataclass(frozen=True)
class _Refused:
    """A photograph that cannot be used, and why."""

    path: Path
    error: str


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    track = commands.add_parser("track", help="follow a camera through a folder of photographs, without a service")
    track.add_argument("plan", type=Path, metavar="PLAN", help="a floor plan, as for `lalaloc localise`")
    track.add_argument(
        "folder", type=Path, metavar="FOLDER", help="photographs named by their time in seconds, such as 12.50.jpg"
    )
    track.add_argument(
        "--odometry",
        type=Path,
        metavar="FILE",
        help="poses of the robot: TUM lines, or CSV with time_s, x_m, y_m and yaw_deg, counter-clockwise from +x",
    )
    track.add_argument(
        "--odometry-frame",
        choices=("auto", "optical", "rep103"),
        default="auto",
        help="axes of TUM poses: rep103 (x forward, z up) or optical (z forward, y down), as of visual SLAM (default: "
        "by the direction that stays upright)",
    )
    track.add_argument(
        "--mount",
        type=heading,
        default=0.0,
        metavar="DEG",
        help="azimuth of the photographs' centre relative to the odometry's x, clockwise (default: 0)",
    )
    add_options(track, "--camera-height")
    add_camera_options(track)
    track.add_argument("--trajectory", type=Path, metavar="FILE", help="TUM file of the poses in the plan to write")
    track.add_argument("--out", type=Path, metavar="FILE", help="picture of the path to write, .png or .svg")
    track.add_argument("--json", action="store_true", help="print JSON: a list with one pose per photograph")
    add_options(track, "--bundle")
    add_plan_options(track)
    track.set_defaults(run=_track)


def _track(arguments: argparse.Namespace) -> None:
    from lalaloc_core.localise.tracking.trajectories import read_trajectory, tum_line

    if arguments.out is not None:
        check_picture_name(arguments.out)
    plan = read_plan(arguments.plan, arguments).plan()
    stated = stated_camera(arguments)
    photographs = _photographs(arguments.folder)
    trajectory = None
    if arguments.odometry is not None:
        trajectory = read_trajectory(_text(arguments.odometry), arguments.odometry_frame)
        for warning in trajectory.warnings:
            print(f"warning: {arguments.odometry}: {warning}", file=sys.stderr)
    answers = _followed(arguments, plan, photographs, trajectory, stated)
    found = [answer for answer in answers if isinstance(answer, _Found)]
    if not found:
        raise InvalidPhotographError(f"none of {len(answers)} photographs can be used; see the errors above")
    if arguments.trajectory is not None:
        poses = [(answer, answer.tracked.pose) for answer in found]
        lines = [
            tum_line(answer.time_s, pose.position_m, _height_m(answer.tracked), pose.heading) for answer, pose in poses
        ]
        write_text(arguments.trajectory, "\n".join(lines) + "\n")
    if arguments.out is not None:
        write_picture(_picture(plan, [answer.tracked for answer in found]), arguments.out)
    documents = [_document(answer, plan) for answer in answers]
    if arguments.json:
        print_json(documents, JSON_DECIMALS)
    else:
        rows = [
            (answer.path.name, pose["mode"], *pose_cells(pose), f"{100.0 * pose['probability']:.1f} %")
            for answer, pose in zip(answers, documents, strict=True)
            if "error" not in pose
        ]
        print_table(_HEAD, rows)
    if len(found) < len(answers):
        failed = len(answers) - len(found)
        raise InvalidPhotographError(f"{failed} of {len(answers)} photographs were left out; see the errors above")


def _photographs(folder: Path) -> list[tuple[float, Path]]:
    """Return times (s) and files of photographs, by rising time."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    except OSError as error:
        raise InvalidInputError(f"'{folder}' cannot be read: {error.strerror}") from error
    if not files:
        raise InvalidInputError(f"'{folder}' has no photographs ({', '.join(sorted(_SUFFIXES))})")
    found = []
    for path in files:
        try:
            found.append((float(path.stem), path))
        except ValueError as error:
            raise InvalidInputError(f"'{path.name}' is not named by a time in seconds, such as 12.50.jpg") from error
    if not all(math.isfinite(time_s) for time_s, _ in found):
        raise InvalidInputError(f"a photograph of '{folder}' is named by a time that is not finite")
    return sorted(found)


def _followed(
    arguments: argparse.Namespace,
    plan: FloorPlan,
    photographs: list[tuple[float, Path]],
    trajectory: Trajectory | None,
    stated: StatedCamera,
) -> list[_Found | _Refused]:
    """Return the answer of each photograph, with a progress bar on a terminal.

    Odometry leads from the last photograph that can be used to the next one.
    """
    from tqdm import tqdm

    from lalaloc_core.bundle import Bundle
    from lalaloc_core.localise.local_model import LocalModel
    from lalaloc_core.localise.query import known_heading, stated_height
    from lalaloc_core.localise.search.pipeline import run_steps
    from lalaloc_core.localise.tracking import TrackState
    from lalaloc_core.localise.tracking.tracked_plans import TrackedPlans
    from lalaloc_core.localise.tracking.tracking_filter import track_steps
    from lalaloc_core.localise.tracking.trajectories import OdometryErrors

    model = LocalModel(Bundle.open(arguments.bundle))
    height = stated_height(plan, arguments.camera_height)
    ground, errors, mount = (
        TrackedPlans.of_plan(plan, model.grid(plan, height.height_m)),
        OdometryErrors(),
        arguments.mount,
    )
    state, before_s = None, None
    found: list[_Found | _Refused] = []
    for time_s, path in tqdm(photographs, desc="track", unit="photograph", disable=None, leave=False):
        try:
            content = content_of(path)
            with named(path):
                view = model.open(content, stated)
                query = model.encoder.query(view, None, height)
        except InvalidPhotographError as error:
            print(f"error: {error}", file=sys.stderr)
            found.append(_Refused(path, str(error)))
            continue
        state = state or TrackState.first(len(query.roll))
        motion = None
        if trajectory is not None and before_s is not None:
            motion = trajectory.motion(before_s, time_s, errors, math.radians(mount))
        known = known_heading(plan.north, None, 0.0, view.compass_heading)
        steps = track_steps(ground, model.encoder, state, query, motion, known_heading=known)
        answer = run_steps(steps, model.refiner)
        contradictions = [f"the photographs contradict {name} of the odometry" for name in answer.contradicted]
        for warning in (*view.warnings, *contradictions):
            print(f"warning: {path}: {warning}", file=sys.stderr)
        found.append(_Found(path, time_s, view_document(view), answer))
        state, before_s = answer.state, time_s
    return found


def _height_m(answer: Tracked) -> float:
    return answer.query.camera_height.height_m * math.exp(answer.candidates[0].height_offset)


def _picture(plan: FloorPlan, found: list[Tracked]) -> str:
    import numpy as np

    from lalaloc_core.draw.plan_overlays import DrawnPath, draw_path

    position_m = np.stack([answer.pose.position_m for answer in found])
    is_sure = [answer.pose.mode == "tracking" for answer in found]
    return draw_path(plan, DrawnPath(position_m, is_sure, math.degrees(found[-1].pose.heading)))


def _document(answer: _Found | _Refused, plan: FloorPlan) -> dict[str, Any]:
    """Return an answer as JSON, with the field names of the API."""
    if isinstance(answer, _Refused):
        return {"photograph": str(answer.path), "error": answer.error}
    pose = answer.tracked.pose
    return {
        "photograph": str(answer.path),
        "number": pose.number,
        "mode": pose.mode,
        **pose_document(plan, pose.room_index, pose.x_m, pose.y_m, math.degrees(pose.heading) % 360.0),
        "probability": pose.probability,
        "motion_contradicted": list(answer.tracked.contradicted),
        "view": answer.view,
    }


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"'{path}' cannot be read as text: {error}") from error
