"""Options of commands about the camera of photographs."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from typing import TYPE_CHECKING

from lalaloc_core.cli.options import add_options

if TYPE_CHECKING:
    from lalaloc_core.photograph import Intrinsics, StatedCamera


_OPTIONS = """
--projection NAME: equirectangular (360° cameras), perspective, cylindrical (a phone's panorama mode) or fisheye
    (default: by the photographs' metadata, else by the pictures)
--hfov DEG: horizontal field of view of the upright photographs (default: by their metadata, else estimated)
--intrinsics JSON: camera matrix and distortion by OpenCV instead, such as '{"fx": 2870, "fy": 2868, "k1": -0.03}'
--pitch DEG: elevation of the photographs' centres above the horizon (default: estimated)
--roll DEG: clockwise rotation of the camera about its optical axis (default: estimated)
"""


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about the camera of photographs."""
    add_options(parser, _OPTIONS, projection={"default": "auto"}, intrinsics={"type": _intrinsics})


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
