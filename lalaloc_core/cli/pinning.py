"""`lalaloc pin`: pin a folder of photographs to a plan, and write what people take away."""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.cameras import add_camera_options, content_of, stated_camera
from lalaloc_core.cli.options import add_options
from lalaloc_core.cli.plan_files import add_plan_options, read_plans
from lalaloc_core.cli.printing import JSON_DECIMALS, print_json, print_table
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError

if TYPE_CHECKING:
    from lalaloc_core.cli.pin_files import PinnedFile
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.album.entry import AlbumPhotograph
    from lalaloc_core.localise.album.pins import Album
    from lalaloc_core.photograph import StatedCamera

# Files that can be photographs; others are counted and left out.
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".insp"})
_HEAD = ("no", "photograph", "room", "x m", "y m", "heading °", "confidence", "state")


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    pin = commands.add_parser(
        "pin", help="pin a folder of photographs to a plan: tables, a map, a PDF report, and copies with their place"
    )
    pin.add_argument(
        "plan", type=Path, metavar="PLAN", help="a floor plan, in any format of docs/how-to/import-a-plan.md"
    )
    pin.add_argument("folder", type=Path, metavar="FOLDER", help="folder of photographs, up to 500; never changed")
    pin.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write, which is created")
    pin.add_argument(
        "--previous",
        type=Path,
        metavar="FILE",
        help="pins.json of an earlier run; list what moved since, such as in a new revision of the plan",
    )
    pin.add_argument("--no-copies", action="store_true", help="write no copies of the photographs")
    pin.add_argument("--json", action="store_true", help="print JSON instead of a table")
    add_camera_options(pin)
    add_options(pin, "--bundle")
    add_plan_options(pin)
    pin.set_defaults(run=_pin)


def _pin(arguments: argparse.Namespace) -> None:
    from lalaloc_core.cli.pin_files import moved_lines, pins_document, read_previous, write_pin_files

    paths, notes = _photographs_in(arguments.folder, arguments.out, arguments.plan)
    previous = None if arguments.previous is None else read_previous(arguments.previous)
    stated = stated_camera(arguments)
    plans = [imported.plan() for imported in read_plans(arguments.plan, arguments)]
    ids = _plan_ids(plans)
    files, photographs, album = _solved(arguments, plans, ids, paths, stated)
    notes += _notes_of(files, len(photographs))
    notes += album.warnings
    moved = [] if previous is None else moved_lines(previous, album.pins, files)
    document = pins_document(plans, ids, album, files, notes, moved)
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        notes += write_pin_files(arguments.out, plans, ids, album, files, document, copies=not arguments.no_copies)
    except OSError as error:
        raise InvalidInputError(f"'{arguments.out}' cannot be written: {error.strerror}") from error
    for note in (*notes, *moved):
        print(f"note: {note}", file=sys.stderr)
    if arguments.json:
        print_json(document, JSON_DECIMALS)
    else:
        print_table(_HEAD, [_row(entry) for entry in document["photographs"]])
        counts = ", ".join(f"{count} {state.replace('_', ' ')}" for state, count in document["counts"].items() if count)
        print(f"{counts}; see {arguments.out / 'report.pdf'}")


def _photographs_in(folder: Path, out: Path, plan: Path) -> tuple[list[Path], list[str]]:
    """Return the files of a folder that can be photographs, sorted by name, and notes on what is left out."""
    from lalaloc_core.localise.album.solve import MAX_PHOTOGRAPHS

    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise InvalidInputError(f"'{folder}' cannot be read as a folder: {error.strerror}") from error
    if out.resolve() == folder.resolve():
        raise InvalidInputError("--out is the folder of the photographs, which is never changed; choose another one")
    files = [entry for entry in entries if entry.is_file() and not _is_same(entry, plan)]
    found = [entry for entry in files if entry.suffix.lower() in _SUFFIXES]
    folders = [entry for entry in entries if entry.is_dir() and not _is_same(entry, out)]
    notes = []
    if len(found) < len(files):
        notes.append(f"'{folder}' has files that are no pictures, which are left out: {len(files) - len(found)}")
    if folders:
        notes.append(f"'{folder}' has folders, which are left out: {len(folders)}; pin them by themselves")
    if not found:
        raise InvalidInputError(f"'{folder}' has no photographs ({', '.join(sorted(_SUFFIXES))})")
    if len(found) > MAX_PHOTOGRAPHS:
        raise InvalidInputError(
            f"'{folder}' has {len(found)} photographs; the limit is {MAX_PHOTOGRAPHS}: divide them into several folders"
        )
    return found, notes


def _is_same(entry: Path, other: Path) -> bool:
    return entry.resolve() == other.resolve()


def _plan_ids(plans: Sequence[FloorPlan]) -> list[str]:
    """Return a name for each plan that stays in its next revision: that of the level, or "plan" for the only one."""
    if len(plans) == 1:
        return ["plan"]
    names = [plan.name for plan in plans]
    return [name if names.count(name) == 1 else f"{name} {number}" for number, name in enumerate(names, start=1)]


def _solved(
    arguments: argparse.Namespace,
    plans: Sequence[FloorPlan],
    ids: Sequence[str],
    paths: Sequence[Path],
    stated: StatedCamera,
) -> tuple[list[PinnedFile], list[AlbumPhotograph], Album]:
    """Read and pin the photographs."""
    from tqdm import tqdm

    from lalaloc_core.bundle import Bundle
    from lalaloc_core.localise.album.ground import AlbumGround
    from lalaloc_core.localise.album.solve import solve_album
    from lalaloc_core.localise.local_model import LocalModel
    from lalaloc_core.localise.venue.merged_plans import MergedPlans

    model = LocalModel(Bundle.open(arguments.bundle))
    files: list[PinnedFile] = []
    photographs: dict[str, AlbumPhotograph] = {}
    for file, photograph in _read(
        model, tqdm(paths, desc="read", unit="photograph", disable=None, leave=False), stated
    ):
        files.append(file)
        if photograph is not None:
            photographs.setdefault(photograph.id, photograph)
    if not photographs:
        raise InvalidPhotographError(f"none of {len(files)} photographs can be read; the first: {files[0].reason}")
    grids = [model.grid(plan, plan.camera_height_m) for plan in plans]
    if len(plans) == 1:
        ground = AlbumGround.of_plan(ids[0], plans[0], grids[0])
    else:
        ground = AlbumGround.of_venue(ids, MergedPlans.of(plans, grids, plans[0].camera_height_m))
    with tqdm(total=len(photographs), desc="pin", unit="photograph", disable=None, leave=False) as bar:
        album = solve_album(ground, model.encoder, list(photographs.values()), progress=lambda _: bar.update())
    return files, list(photographs.values()), album


def _read(model: Any, paths: Any, stated: StatedCamera) -> Iterator[tuple[PinnedFile, AlbumPhotograph | None]]:
    """Yield every file and its photograph; None if it cannot be read or is a copy of an earlier one."""
    from lalaloc_core.cli.pin_files import PinnedFile
    from lalaloc_core.localise.album.entry import photograph_entry
    from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
    from lalaloc_core.photograph import open_photograph
    from lalaloc_core.photograph.overlap import ALBUM_SIDE
    from lalaloc_core.photograph.taken import read_taken

    known: dict[str, str] = {}
    sizes = {"sphere_size": sphere_size(model.bundle.manifest), "patch_size": patch_size(model.bundle.manifest)}
    for number, path in enumerate(paths, start=1):
        try:
            content = content_of(path)
            id = hashlib.sha256(content).hexdigest()
            if id in known:
                yield PinnedFile(number, path, id, taken=known[id]), None
                continue
            view = model.encoder.with_features(open_photograph(content, stated=stated, overview=ALBUM_SIDE, **sizes))
            taken = read_taken(content)
        except InvalidPhotographError as error:
            yield PinnedFile(number, path, None, str(error)), None
            continue
        known[id] = "" if taken.at is None else taken.at.isoformat(sep=" ", timespec="seconds")
        yield PinnedFile(number, path, id, taken=known[id]), photograph_entry(id, view, taken)


def _notes_of(files: Sequence[PinnedFile], photographs: int) -> list[str]:
    """Return notes on unreadable files and copies."""
    notes = [f"'{file.path.name}' is set aside: {file.reason}" for file in files if file.id is None]
    copies = sum(file.id is not None for file in files) - photographs
    if copies:
        notes.append(f"copies of other files, which have the same pin: {copies}")
    return notes


def _row(entry: dict[str, Any]) -> tuple[str, ...]:
    if entry["room"] is None:
        return (str(entry["number"]), entry["photograph"], "-", "-", "-", "-", "-", "set aside")
    heading = entry["heading_deg"]
    return (
        str(entry["number"]),
        entry["photograph"],
        entry["room"],
        f"{entry['position']['x_m']:.2f}",
        f"{entry['position']['y_m']:.2f}",
        "-" if heading is None else f"{heading:.0f}",
        f"{100.0 * entry['confidence']:.0f} %",
        entry["state"].replace("_", " "),
    )
