"""Plans as commands take them: a file of any format that is read, and what to make of it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError

if TYPE_CHECKING:
    from lalaloc_core.importers import ImportedPlan

# The options of an import, as `plans.ImportOptions.from_text` takes them.
_OPTIONS = {
    "units": "unit of the file's coordinates: m, cm, mm, in or ft",
    "scale": "scale of a drawing on paper, 1:100",
    "metres-per-pixel": "length of a pixel, or of a unit of an SVG",
    "known-distance": "two points of the drawing and how far apart they are: x0,y0,x1,y1,metres",
    "level": "name or number of the storey to take",
    "layers": "take only these layers, groups or classes; separated by commas",
    "page": "page of a PDF, from 1",
    "y-axis": "which way y points in the file: up or down",
    "ceiling-height-m": "ceiling of rooms whose file gives none",
    "name": "what to call the plan",
}


def add_plan_options(parser: argparse.ArgumentParser) -> None:
    """Add what may be said of a plan's file."""
    group = parser.add_argument_group(
        "of the plan's file, where it does not say so itself (docs/how-to/import-a-plan.md)"
    )
    for name, meaning in _OPTIONS.items():
        group.add_argument(f"--{name}", help=meaning)


def read_plans(file: Path, arguments: argparse.Namespace) -> tuple[ImportedPlan, ...]:
    """The plans in a file, one for each level.

    Raises:
        InvalidFloorPlanError: the file cannot be read, or is no plan.
    """
    from lalaloc_core.importers import ImportOptions, import_plans

    said = {name.replace("-", "_"): getattr(arguments, name.replace("-", "_")) for name in _OPTIONS}
    options = ImportOptions.from_text({name: value for name, value in said.items() if value is not None})
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InvalidFloorPlanError(f"'{file}' cannot be read: {error.strerror}") from error
    return import_plans(content, options)


def read_plan(file: Path, arguments: argparse.Namespace) -> ImportedPlan:
    """The one plan in a file.

    Raises:
        InvalidFloorPlanError: there are several, or none.
    """
    plan, *others = read_plans(file, arguments)
    if others:
        raise InvalidFloorPlanError(f"the file has {1 + len(others)} levels, choose one with --level")
    return plan


def write_picture(svg: str, out: Path) -> None:
    """Write a drawing as the name of its file says.

    Raises:
        InvalidInputError: neither .svg nor .png, or it cannot be written.
    """
    from lalaloc_core.draw import rasterise

    check_picture_name(out)
    try:
        out.write_bytes(rasterise(svg) if out.suffix.lower() == ".png" else svg.encode())
    except OSError as error:
        raise InvalidInputError(f"'{out}' cannot be written: {error.strerror}") from error


def check_picture_name(out: Path) -> None:
    """Raises:
    InvalidInputError: a picture's file is called neither .svg nor .png.
    """
    if out.suffix.lower() not in (".svg", ".png"):
        raise InvalidInputError(f"the picture is called '{out.name}', it must end in .png or .svg")
