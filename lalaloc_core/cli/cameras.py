"""Options of commands about the camera of photographs, and what was assumed about it."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.errors import ForeignFeaturesError, InvalidFeaturesError, InvalidPhotographError

if TYPE_CHECKING:
    from lalaloc_core.photograph import Assumed, Intrinsics, Photograph, StatedCamera


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


def content_of(path: Path) -> bytes:
    """Return the bytes of a photograph.

    Raises:
        InvalidPhotographError: the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidPhotographError(f"'{path}' cannot be read: {error.strerror}") from error


def view_document(view: Photograph) -> dict[str, Any]:
    """Return what was assumed about a photograph, with the field names of the API."""

    def angle(assumed: Assumed) -> dict[str, Any]:
        return {"value_deg": math.degrees(assumed.value), "std_deg": math.degrees(assumed.sd), "source": assumed.source}

    angles = {name: angle(getattr(view, name)) for name in ("hfov", "pitch", "roll")}
    if view.wall_direction is not None:
        angles["wall_direction"] = angle(view.wall_direction)
    return {"projection": view.projection, "projection_source": view.projection_source, **angles}


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the photograph in errors about it."""
    try:
        yield
    except (InvalidFeaturesError, ForeignFeaturesError) as error:
        raise InvalidPhotographError(f"'{path}': {error}") from error
    except InvalidPhotographError as error:
        raise InvalidPhotographError(f"'{path}': {error}; see docs/how-to/take-photographs.md") from error
