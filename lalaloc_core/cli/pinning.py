"""`lalaloc pin`: pin a folder of photographs to a plan, and write what people take away."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lalaloc_core.cli.cameras import add_camera_options, stated_camera
from lalaloc_core.cli.options import BUNDLE, PLAN, add_options
from lalaloc_core.cli.plan_files import add_plan_options, read_plans
from lalaloc_core.cli.printing import JSON_DECIMALS, print_json, print_table, print_warnings, with_options
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.shown_text import printable, probability_text

_OPTIONS = f"""
{PLAN}
folder FOLDER: folder of photographs, up to 500; never changed
--out DIR: folder to write, which is created; it must be new or empty
--replace: write over the files of an earlier run in --out; others there stay
--previous FILE: pins.json of an earlier run; list what moved since, such as in a new revision of the plan
--no-copies: write no copies of the photographs
--json: print JSON instead of a table
{BUNDLE}
"""
_HEAD = ("no", "photograph", "room", "x m", "y m", "heading °", "room right", "within 1 m", "state")


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    pin = commands.add_parser(
        "pin", help="pin a folder of photographs to a plan: tables, a map, a PDF report, and copies with their place"
    )
    add_options(pin, _OPTIONS, out={"required": True})
    add_camera_options(pin)
    add_plan_options(pin)
    pin.set_defaults(run=_pin)


def _pin(arguments: argparse.Namespace) -> None:
    from lalaloc_core.api import LaLaLoc
    from lalaloc_core.cli.pin_files import write_pin_files
    from lalaloc_core.localise.answers.pinned import read_pins
    from lalaloc_core.photograph.picture_folders import left_out, pictures_in

    folder, plan = arguments.folder, arguments.plan
    paths = [path for path in pictures_in(folder) if path.resolve() != plan.resolve()]
    notes = [f"'{folder}': {text}" for text in left_out(folder, [*paths, arguments.out, plan])]
    _check_out(arguments.out, [*paths, arguments.plan, arguments.previous], replace=arguments.replace)
    previous = None if arguments.previous is None else read_pins(arguments.previous)
    stated = stated_camera(arguments)
    plans = [imported.plan() for imported in read_plans(arguments.plan, arguments)]
    with _progress_bars() as progress:
        pinned = LaLaLoc(arguments.bundle).pin(plans, paths, camera=stated, progress=progress)
    pinned.notes[:0] = notes
    moved = [] if previous is None else pinned.moved_since(previous)
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        document = write_pin_files(arguments.out, pinned, paths, moved, copies=not arguments.no_copies)
    except OSError as error:
        raise InvalidInputError(f"'{arguments.out}' cannot be written: {error.strerror}") from error
    for note in (*document["notes"], *moved):
        print(f"note: {with_options(note)}", file=sys.stderr)
    print_warnings((row["photograph"], text) for row in document["photographs"] for text in row.get("warnings", ()))
    if arguments.json:
        print_json(document, JSON_DECIMALS)
    else:
        print_table(_HEAD, [_row(entry) for entry in document["photographs"]])
        counts = ", ".join(f"{count} {state.replace('_', ' ')}" for state, count in document["counts"].items() if count)
        print(printable(f"{counts}; see {arguments.out / 'report.pdf'}"))


@contextmanager
def _progress_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Give a function that shows the progress of each stage on a terminal."""
    from tqdm import tqdm

    bars: dict[str, Any] = {}
    with ExitStack() as shown:

        def show(stage: str, done: int, count: int) -> None:
            if stage not in bars:
                shown.close()
                bar = tqdm(total=count, desc=stage, unit="photograph", disable=None, leave=False)
                bars[stage] = shown.enter_context(bar)
            bars[stage].update(done - bars[stage].n)

        yield show


def _check_out(out: Path, sources: Iterable[Path | None], *, replace: bool) -> None:
    """Refuse a folder where files that are read would be written, or others unasked."""
    from lalaloc_core.cli.pin_files import COPIES

    written = [folder for folder in (out, out / COPIES) if folder.is_dir()]
    sources = [path for path in sources if path is not None and path.exists()]
    places = ((path, folder) for path in sources for folder in (path.parent, path.resolve().parent))
    read = next((path for path, folder in places if any(map(folder.samefile, written))), None)
    if read is not None:
        raise InvalidInputError(
            f"--out would write beside '{printable(str(read))}', which is read and never changed; choose another folder"
        )
    if out.exists() and not out.is_dir():
        raise InvalidInputError(f"'{out}' is no folder; choose another name")
    is_used = out.is_dir() and any(not path.name.startswith(".") for path in out.iterdir())
    if is_used and not (replace and (out / "pins.json").is_file()):
        raise InvalidInputError(
            f"'{out}' has files; choose a new folder, or add --replace to write over an earlier run's"
        )


def _row(entry: dict[str, Any]) -> tuple[str, ...]:
    if entry["room"] is None:
        return (str(entry["number"]), entry["photograph"], *6 * ("-",), "set aside")
    heading = entry["heading_deg"]
    return (
        str(entry["number"]),
        entry["photograph"],
        entry["room"],
        f"{entry['position']['x_m']:.2f}",
        f"{entry['position']['y_m']:.2f}",
        "-" if heading is None else f"{heading:.0f}",
        probability_text(entry["room_confidence"], 0),
        probability_text(entry["within_1m"], 0),
        entry["state"].replace("_", " "),
    )
