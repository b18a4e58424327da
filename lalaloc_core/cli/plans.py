"""`lalaloc plan`: import, check, draw and export floor plans."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.options import BUNDLE, add_options
from lalaloc_core.cli.plan_files import (
    add_plan_options,
    check_free,
    check_picture_name,
    read_plan,
    read_plans,
    write_picture,
)
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError
from lalaloc_core.shown_text import printable

if TYPE_CHECKING:
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.importers import ImportedPlan


_IMPORT_OPTIONS = """
-o, --out FILE: file to write (default: standard output)
--all-levels: write a plan of every level with rooms to the folder --out
--debug PICTURE: draw what was read from a drawing or picture, .png or .svg
--replace: write over files that exist, with --all-levels or --debug
"""
_CHECK_OPTIONS = f"""
--json: print JSON
--localisability: also predict which photographs of the plan will be found
--picture FILE: map of that probability, .png or .svg; needs --localisability
{BUNDLE}
"""
_DRAW_OPTIONS = "--out FILE: picture to write, .png or .svg"
_EXPORT_OPTIONS = """
--format FORMAT: native, geojson, imdf, dxf, svg or ros
--out FILE: file to write
--anchor ANCHOR: latitude,longitude[,north_deg] of the plan's origin, for geojson and imdf
--like YAML: map whose origin, resolution and size the export has, for ros
"""


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    plan = commands.add_parser("plan", help="import, check, draw and export floor plans (docs/how-to/import-a-plan.md)")
    actions = plan.add_subparsers(required=True, metavar="ACTION")
    importing = actions.add_parser("import", help="convert a file of any supported format to a plan, with a report")
    add_options(importing, _IMPORT_OPTIONS)
    check = actions.add_parser("check", help="print the warnings of a plan")
    add_options(check, _CHECK_OPTIONS)
    draw = actions.add_parser("draw", help="draw a plan as PNG or SVG")
    add_options(draw, _DRAW_OPTIONS, out={"required": True})
    export = actions.add_parser("export", help="write a plan in another format")
    add_options(export, _EXPORT_OPTIONS, format={"required": True}, out={"required": True})
    for action, run in ((importing, _import), (check, _check), (draw, _draw), (export, _export)):
        add_options(action, "file FILE: floor plan, in any supported format")
        add_plan_options(action)
        action.set_defaults(run=run)


def _import(arguments: argparse.Namespace) -> None:
    if arguments.all_levels and arguments.out is None:
        raise InvalidInputError("--all-levels needs a folder for the plans; add --out FOLDER")
    from lalaloc_core.importers import without_storeys_beside

    if arguments.debug is not None:
        check_picture_name(arguments.debug, "--debug")
        check_free([arguments.debug], [], replace=arguments.replace)
    plans: Sequence[ImportedPlan] = (
        _read_traced(arguments) if arguments.debug else read_plans(arguments.file, arguments)
    )
    plans = plans if arguments.all_levels else without_storeys_beside(plans)
    # Write before printing: a reader such as `head` may close the pipe.
    written = [] if arguments.out is None else _files(plans, arguments)
    # A single file has the name that was asked for.
    check_free(written, [arguments.file], replace=arguments.replace or written == [arguments.out])
    _write_plans(plans, written)
    for plan in plans:
        heading = "" if plan.level is None else f"level '{plan.level.name}': "
        print(f"{heading}{json.dumps(plan.report.to_dict(), ensure_ascii=False, indent=1)}", file=sys.stderr)
    if arguments.out is None:
        print_json(plans[0].document if len(plans) == 1 else [plan.document for plan in plans])
    for out in written:
        print(printable(str(out)))


def _read_traced(arguments: argparse.Namespace) -> tuple[ImportedPlan, ...]:
    """Read the plans in a file, and draw what was read, also of a file that is refused."""
    from lalaloc_core.draw.plan_overlays import trace_svg
    from lalaloc_core.importers import Trace

    trace = Trace()
    try:
        return read_plans(arguments.file, arguments, trace)
    finally:
        write_picture(trace_svg(trace, arguments.file.name), arguments.debug)
        print(f"drawn: {arguments.debug}", file=sys.stderr)


def _files(plans: Sequence[ImportedPlan], arguments: argparse.Namespace) -> list[Path]:
    """Return the file of each plan: `--out`, else numbered files beside it or files in it, named by their levels."""
    out = arguments.out
    if arguments.all_levels:
        names = [_file_name(arguments.file.stem if plan.level is None else plan.level.title) for plan in plans]
        doubles = {name for name, count in Counter(names).items() if count > 1}
        return [
            out / (f"{name}-{number}.json" if name in doubles else f"{name}.json") for number, name in enumerate(names)
        ]
    return [out] if len(plans) == 1 else [out.with_stem(f"{out.stem}-{number}") for number in range(len(plans))]


def _file_name(text: str) -> str:
    """Return a text as the stem of a file's name: "Level 1/A" is "level-1-a"."""
    return re.sub(r"[^\w-]+", "-", text.casefold()).strip("-") or "level"


def _write_plans(plans: Sequence[ImportedPlan], files: Sequence[Path]) -> None:
    try:
        for file, plan in zip(files, plans, strict=False):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(plan.document, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InvalidInputError(f"'{error.filename}' cannot be written: {error.strerror}") from error


def _check(arguments: argparse.Namespace) -> None:
    if arguments.picture is not None and not arguments.localisability:
        raise InvalidInputError("--picture draws the localisability; add --localisability")
    messages, plans = [], []
    imports = read_plans(arguments.file, arguments)
    if arguments.picture is not None and len(imports) > 1:
        raise InvalidInputError(f"--picture draws one plan and the file has {len(imports)} levels; add --level")
    for imported in imports:
        plan = imported.plan()
        report = imported.report
        warnings = list(dict.fromkeys([*report.warnings, *report.unsure, *plan.warnings]))
        messages += warnings
        summary = {"rooms": len(plan.rooms), "area_m2": round(plan.area_m2, 2), "openings": len(plan.openings)}
        plans.append({"name": plan.name, **summary, "warnings": warnings})
        if not arguments.json:
            print(f"'{plan.name}': {len(plan.rooms)} rooms, {plan.area_m2:.1f} m², {len(plan.openings)} openings")
        if arguments.localisability:
            report, lines = _localisability(plan, arguments)
            plans[-1]["localisability"] = report
            if not arguments.json:
                print("\n".join(lines))
    if arguments.json:
        print_json(plans)
        return
    for message in messages:
        print(f"- {message}")


def _localisability(plan: FloorPlan, arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return the report of a plan's localisability, and its summary; draw it on request."""
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.draw.heat import localisability_svg
    from lalaloc_core.localise.localisability.predicted_localisability import localisability
    from lalaloc_core.localise.localisability.reports import report_of, summary_of

    if arguments.picture is not None:
        check_picture_name(arguments.picture, "--picture")
    found = localisability(plan, Bundle.open(arguments.bundle).manifest)
    report = report_of(plan, found)
    if arguments.picture is not None:
        write_picture(localisability_svg(plan, report), arguments.picture)
    return report, summary_of(plan, found)


def _draw(arguments: argparse.Namespace) -> None:
    from lalaloc_core.draw.plan import plan_svg

    check_picture_name(arguments.out)
    imported = read_plan(arguments.file, arguments)
    write_picture(plan_svg(imported.plan(), no_room=imported.report.no_room), arguments.out)
    print(printable(str(arguments.out)))


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.importers import export_plan

    plan = read_plan(arguments.file, arguments)
    anchor = plan.anchor if arguments.anchor is None else _anchor(arguments.anchor)
    if arguments.like is None:
        content = export_plan(plan.plan(), arguments.format, anchor)
    elif arguments.format != "ros":
        raise InvalidInputError(f"--like is for --format ros; the format is '{arguments.format}'")
    else:
        from lalaloc_core.importers.formats.ros import map_files, read_frame, write

        content = write(plan.plan().to_dict(), anchor, read_frame(map_files(arguments.like)))
    arguments.out.write_bytes(content)
    print(printable(str(arguments.out)))


def _anchor(text: str) -> Any:
    from lalaloc_core.importers import Anchor

    try:
        numbers = [float(part) for part in text.split(",")]
        latitude, longitude = numbers[:2]
        north_deg = numbers[2] if len(numbers) > 2 else 0.0
    except (ValueError, IndexError) as error:
        raise InvalidFloorPlanError(f"--anchor is '{text[:50]}'; it must be latitude,longitude[,north_deg]") from error
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(north_deg) <= 360.0) or len(numbers) > 3:
        raise InvalidFloorPlanError(
            f"--anchor is '{text[:50]}'; latitude must be within ±90, longitude within ±180, north_deg within ±360"
        )
    return Anchor(latitude, longitude, north_deg=north_deg)
