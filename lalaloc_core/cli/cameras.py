"""Options of commands about the camera of photographs."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lalaloc_core.photograph import Intrinsics, StatedCamera


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the camera of photographs."""
    parser.add_argument(
        "--projection",
        default="auto",
        metavar="NAME",
        help="equirectangular (360° cameras), perspective, cylindrical (a phone's panorama mode) or fisheye (default: "
        "by the photographs' metadata, else by the pictures)",
    )
    parser.add_argument(
        "--hfov",
        type=float,
        metavar="DEG",
        help="horizontal field of view of the upright photographs (default: by their metadata, else estimated)",
    )
    parser.add_argument(
        "--intrinsics",
        type=_intrinsics,
        metavar="JSON",
        help='camera matrix and distortion by OpenCV instead, such as \'{"fx": 2870, "fy": 2868, "k1": -0.03}\'',
    )
    parser.add_argument(
        "--pitch",
        type=float,
        metavar="DEG",
        help="elevation of the photographs' centres above the horizon (default: estimated)",
    )
    parser.add_argument(
        "--roll",
        type=float,
        metavar="DEG",
        help="clockwise rotation of the camera about its optical axis (default: estimated)",
    )


def _intrinsics(text: str) -> Intrinsics:
    from lalaloc_core.photograph import Intrinsics

    try:
        values = json.loads(text)
        return Intrinsics(**{name: float(value) for name, value in values.items()})
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        names = ", ".join(field.name for field in fields(Intrinsics))
        raise argparse.ArgumentTypeError(
            f"'{text[:100]}' must be a JSON object with numbers: fx, fy, and any others of {names}"
        ) from error


def stated_camera(arguments: argparse.Namespace) -> StatedCamera:
    """Return the statements of `add_camera_options`."""
    from lalaloc_core.photograph import StatedCamera

    stated = StatedCamera(
        projection=arguments.projection,
        hfov_deg=arguments.hfov,
        intrinsics=arguments.intrinsics,
        pitch_deg=arguments.pitch,
        roll_deg=arguments.roll,
    )
    stated.check()
    return stated
