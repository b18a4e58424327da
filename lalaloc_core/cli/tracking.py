"""`lalaloc track`: follow a camera through a folder of photographs, without a service."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.cameras import add_camera_options, stated_camera
from lalaloc_core.cli.options import BUNDLE, CAMERA_HEIGHT, add_options, heading
from lalaloc_core.cli.plan_files import add_plan_options, check_picture_name, read_plan, write_file, write_picture
from lalaloc_core.cli.printing import JSON_DECIMALS, pose_cells, print_json, print_table, print_warnings, with_options
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError
from lalaloc_core.shown_text import probability_text

if TYPE_CHECKING:
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.answers.documents import TrackedAnswer
    from lalaloc_core.localise.tracking.trajectories import Trajectory
    from lalaloc_core.photograph import StatedCamera

_OPTIONS = f"""
plan PLAN: a floor plan, as for `lalaloc localise`
folder FOLDER: photographs named by their time in seconds, such as 12.50.jpg
--odometry FILE: poses of the robot: TUM lines, or CSV with time_s, x_m, y_m and yaw_deg, counter-clockwise from +x
--odometry-frame: axes of TUM poses: rep103 (x forward, z up) or optical (z forward, y down), as of visual SLAM
    (default: by the direction that stays upright)
--mount DEG: azimuth of the photographs' centre relative to the odometry's x, clockwise (default: 0)
{CAMERA_HEIGHT}
--trajectory FILE: TUM file of the poses in the plan to write
--out FILE: picture of the path to write, .png or .svg
--json: print JSON: a list with one pose per photograph
{BUNDLE}
"""
_HEAD = ("photograph", "mode", "room", "x m", "y m", "heading °", "probability")


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    track = commands.add_parser("track", help="follow a camera through a folder of photographs, without a service")
    frames = {"action": "store", "choices": ("auto", "optical", "rep103"), "default": "auto"}
    add_options(track, _OPTIONS, odometry_frame=frames, mount={"type": heading, "default": 0.0})
    add_camera_options(track)
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
    answers = list(_followed(arguments, plan, photographs, trajectory, stated))
    found = [(time_s, answer) for time_s, answer, _ in answers if answer is not None]
    documents = [document for _, _, document in answers]
    print_warnings((pose["photograph"], text) for pose in documents for text in pose.get("warnings", ()))
    if not found:
        raise InvalidPhotographError(f"none of {len(answers)} photographs can be used; see the errors above")
    if arguments.trajectory is not None:
        lines = [
            tum_line(
                time_s,
                (answer.position.x_m, answer.position.y_m),
                answer.camera_height_m,
                math.radians(answer.heading_deg),
            )
            for time_s, answer in found
        ]
        write_file(arguments.trajectory, "\n".join(lines) + "\n")
    if arguments.out is not None:
        import numpy as np

        from lalaloc_core.draw.plan_overlays import draw_path

        position_m = [(answer.position.x_m, answer.position.y_m) for _, answer in found]
        is_sure = [answer.mode == "tracking" for _, answer in found]
        write_picture(draw_path(plan, np.array(position_m), is_sure, found[-1][1].heading_deg), arguments.out)
    if arguments.json:
        print_json(documents, JSON_DECIMALS)
    else:
        rows = [
            (Path(pose["photograph"]).name, pose["mode"], *pose_cells(pose), probability_text(pose["probability"]))
            for pose in documents
            if "error" not in pose
        ]
        print_table(_HEAD, rows)
    if len(found) < len(answers):
        failed = len(answers) - len(found)
        raise InvalidPhotographError(f"{failed} of {len(answers)} photographs were left out; see the errors above")


def _photographs(folder: Path) -> list[tuple[float, Path]]:
    """Return times (s) and files of photographs, by rising time."""
    from lalaloc_core.photograph.picture_folders import pictures_in

    found = []
    for path in pictures_in(folder):
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
) -> Iterator[tuple[float, TrackedAnswer | None, dict[str, Any]]]:
    """Yield time, answer and document of each photograph, with a progress bar on a terminal.

    Odometry leads from the last photograph that can be used to the next one; one that cannot has no answer.
    """
    from tqdm import tqdm

    from lalaloc_core.api import LaLaLoc

    track, before_s = LaLaLoc(arguments.bundle).track(plan, camera_height_m=arguments.camera_height), None
    for time_s, path in tqdm(photographs, desc="track", unit="photograph", disable=None, leave=False):
        motion = None
        if trajectory is not None and before_s is not None:
            motion = trajectory.motion(before_s, time_s, math.radians(arguments.mount))
        try:
            answer = track.add(path, motion, camera=stated)
        except InvalidPhotographError as error:
            print(f"error: {with_options(error)}", file=sys.stderr)
            yield time_s, None, {"photograph": str(path), "error": str(error)}
            continue
        before_s = time_s
        yield time_s, answer, {"photograph": str(path), **answer.document()}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"'{path}' cannot be read as text: {error}") from error
