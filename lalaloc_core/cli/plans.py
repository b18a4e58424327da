"""`lalaloc plan`: import, check, draw and export floor plans."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.plan_files import add_plan_options, check_picture_name, read_plan, read_plans, write_picture
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidFloorPlanError


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    plan = commands.add_parser("plan", help="import, check, draw and export floor plans (docs/how-to/import-a-plan.md)")
    actions = plan.add_subparsers(required=True, metavar="ACTION")
    importing = actions.add_parser("import", help="convert a file of any supported format to a plan, with a report")
    importing.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: standard output)")
    check = actions.add_parser("check", help="print the warnings of a plan")
    check.add_argument("--json", action="store_true", help="print JSON")
    draw = actions.add_parser("draw", help="draw a plan as PNG or SVG")
    draw.add_argument("--out", type=Path, required=True, metavar="FILE", help="picture to write, .png or .svg")
    export = actions.add_parser("export", help="write a plan in another format")
    export.add_argument("--format", required=True, help="native, geojson, imdf, dxf or svg")
    export.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write")
    export.add_argument("--anchor", help="latitude,longitude[,north_deg] of the plan's origin, for geojson and imdf")
    for action, run in ((importing, _import), (check, _check), (draw, _draw), (export, _export)):
        action.add_argument("file", type=Path, help="floor plan, in any supported format")
        add_plan_options(action)
        action.set_defaults(run=run)


def _import(arguments: argparse.Namespace) -> None:
    plans = read_plans(arguments.file, arguments)
    for plan in plans:
        heading = "" if plan.level is None else f"level '{plan.level.name}': "
        print(f"{heading}{json.dumps(plan.report.to_dict(), ensure_ascii=False, indent=1)}", file=sys.stderr)
    if arguments.out is None:
        print_json(plans[0].document if len(plans) == 1 else [plan.document for plan in plans])
        return
    for number, plan in enumerate(plans):
        out = arguments.out if len(plans) == 1 else arguments.out.with_stem(f"{arguments.out.stem}-{number}")
        out.write_text(json.dumps(plan.document, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
        print(out)


def _check(arguments: argparse.Namespace) -> None:
    messages, plans = [], []
    for imported in read_plans(arguments.file, arguments):
        plan = imported.plan()
        warnings = [*imported.report.warnings, *imported.report.unsure, *plan.warnings]
        messages += warnings
        summary = {"rooms": len(plan.rooms), "area_m2": round(plan.area_m2, 2), "openings": len(plan.openings)}
        plans.append({"name": plan.name, **summary, "warnings": warnings})
        if not arguments.json:
            print(f"'{plan.name}': {len(plan.rooms)} rooms, {plan.area_m2:.1f} m², {len(plan.openings)} openings")
    if arguments.json:
        print_json(plans)
        return
    for message in messages:
        print(f"- {message}")


def _draw(arguments: argparse.Namespace) -> None:
    from lalaloc_core.draw.plan import plan_svg

    check_picture_name(arguments.out)
    write_picture(plan_svg(read_plan(arguments.file, arguments).plan()), arguments.out)
    print(arguments.out)


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.importers import export_plan

    plan = read_plan(arguments.file, arguments)
    anchor = plan.anchor if arguments.anchor is None else _anchor(arguments.anchor)
    arguments.out.write_bytes(export_plan(plan.plan(), arguments.format, anchor))
    print(arguments.out)


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
