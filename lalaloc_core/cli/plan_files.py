"""Input and output of plans for commands: import options, reading, and writing pictures."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError

if TYPE_CHECKING:
    from lalaloc_core.importers import ImportedPlan, ImportStep, OnStep, Trace

# Options of an import, as `importers.ImportOptions.from_text` expects them.
_OPTIONS = {
    "units": "unit of the file's coordinates: m, cm, mm, in or ft",
    "scale": "scale of a drawing on paper, such as 1:100",
    "metres-per-pixel": "metres per pixel, or per unit of an SVG",
    "known-distance": "two points of the drawing and their distance: x0,y0,x1,y1,metres",
    "multiply": "factor for all lengths of a drawing whose scale is false, such as 0.652",
    "crop": "part of a page or picture to read, such as one of several storeys: x0,y0,x1,y1 in the file's coordinates",
    "level": "name or number of the level to import",
    "layers": "import only these layers, groups or classes, separated by commas",
    "page": "page of a PDF, from 1",
    "y-axis": "direction of y in the file: up or down",
    "ceiling-height-m": "ceiling height of rooms without one, in metres",
    "name": "name of the plan (default: the name in the file, else that of the file)",
}


def add_plan_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of an import."""
    group = parser.add_argument_group(
        "of the plan's file, where it does not say so itself (docs/how-to/import-a-plan.md)"
    )
    for name, meaning in _OPTIONS.items():
        group.add_argument(f"--{name}", help=meaning)
    group.add_argument("--is-plan", action="store_true", help="read a picture that looks like a photograph as a plan")


def read_plans(file: Path, arguments: argparse.Namespace, trace: Trace | None = None) -> tuple[ImportedPlan, ...]:
    """Read the plans in a file, one for each level; `trace` receives what is read from a drawing."""
    from lalaloc_core.api import plan_content
    from lalaloc_core.importers import ImportOptions, building_name, import_plans

    values = {name.replace("-", "_"): getattr(arguments, name.replace("-", "_")) for name in _OPTIONS}
    values["plan"] = "true" if arguments.is_plan else None
    options = ImportOptions.from_text({name: value for name, value in values.items() if value is not None})
    content = plan_content(file)
    with _progress_line(file.name) as on_step:
        return import_plans(content, options, building=building_name(file.name), trace=trace, on_step=on_step)


@contextmanager
def _progress_line(name: str) -> Iterator[OnStep | None]:
    """Give a function that shows the step of a file's import on a line of the terminal, which is cleared at the end."""
    if not sys.stderr.isatty():
        yield None
        return

    def show(step: ImportStep) -> None:
        width = shutil.get_terminal_size().columns - 1
        print(f"\r\x1b[K{f'{name}: {step} …'[:width]}", end="", file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def read_plan(file: Path, arguments: argparse.Namespace) -> ImportedPlan:
    """Read the only plan in a file, or the largest of storeys that are drawn beside each other."""
    from lalaloc_core.importers import without_storeys_beside

    plan, *others = without_storeys_beside(read_plans(file, arguments))
    if others:
        raise InvalidFloorPlanError(f"the file has {1 + len(others)} levels; choose one with --level")
    return plan


def write_picture(svg: str, out: Path) -> None:
    """Write a drawing as SVG or PNG, by the file's suffix."""
    from lalaloc_core.draw import rasterise

    write_file(out, rasterise(svg) if out.suffix.lower() == ".png" else svg.encode())


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file; the line ends of text stay as they are, and bytes of names that are no UTF-8 become `?`."""
    try:
        path.write_bytes(content if isinstance(content, bytes) else content.encode(errors="replace"))
    except OSError as error:
        raise InvalidInputError(f"'{path}' cannot be written: {error.strerror}") from error


def check_free(files: Iterable[Path], read: Iterable[Path], *, replace: bool = True) -> None:
    """Refuse to write over files that are read, and over others that exist unless they may be replaced."""
    sources = [path for path in read if path.exists()]
    for file in filter(Path.exists, files):
        if any(map(file.samefile, sources)):
            raise InvalidInputError(f"'{file}' is read and never changed; write another file")
        if not replace:
            raise InvalidInputError(f"'{file}' exists; choose another name, or add --replace to write over it")


def check_picture_name(out: Path, option: str = "--out") -> None:
    """Refuse a picture file with another suffix than .svg or .png."""
    if out.suffix.lower() not in (".svg", ".png"):
        raise InvalidInputError(f"the picture's file is '{out.name}'; it must end in .png or .svg ({option})")
