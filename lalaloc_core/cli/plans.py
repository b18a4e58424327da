"""`lalaloc plan`: import, check and export floor plans."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidFloorPlanError

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


def add_commands(commands: Any) -> None:
    """Add this room's commands to the parser."""
    plan = commands.add_parser("plan", help="import, check and export floor plans (docs/floorplans.md)")
    actions = plan.add_subparsers(required=True, metavar="ACTION")
    bring = actions.add_parser(
        "import", help="make a plan of a file, whatever its format, and say what was used for what"
    )
    bring.add_argument("file", type=Path)
    bring.add_argument("--out", type=Path, help="write the plan in the native format here; else to standard output")
    check = actions.add_parser("check", help="say what is likely wrong with a plan")
    check.add_argument("file", type=Path)
    send = actions.add_parser("export", help="write a plan in another format")
    send.add_argument("file", type=Path)
    send.add_argument("--format", required=True, help="native, geojson, imdf, dxf or svg")
    send.add_argument("--out", type=Path, required=True)
    send.add_argument("--anchor", help="latitude,longitude[,north_deg] of the plan's origin, for geojson and imdf")
    for action in (bring, check, send):
        for name, meaning in _OPTIONS.items():
            action.add_argument(f"--{name}", help=meaning)
    bring.set_defaults(run=_import)
    check.set_defaults(run=_check)
    send.set_defaults(run=_export)


def _import(arguments: argparse.Namespace) -> None:
    plans = _read(arguments)
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
    said = []
    for imported in _read(arguments):
        plan = imported.plan()
        said += [*imported.report.warnings, *imported.report.unsure, *plan.warnings]
        print(f"'{plan.name}': {len(plan.rooms)} rooms, {plan.area_m2:.1f} m², {len(plan.openings)} openings")
    for line in said:
        print(f"- {line}")


def _export(arguments: argparse.Namespace) -> None:
    from lalaloc_core.plans import export_plan

    plans = _read(arguments)
    if len(plans) > 1:
        raise InvalidFloorPlanError(f"the file has {len(plans)} levels, choose one with --level")
    anchor = plans[0].anchor if arguments.anchor is None else _anchor(arguments.anchor)
    arguments.out.write_bytes(export_plan(plans[0].plan(), arguments.format, anchor))
    print(arguments.out)


def _read(arguments: argparse.Namespace) -> Any:
    from lalaloc_core.plans import ImportOptions, import_plans

    said = {name.replace("-", "_"): getattr(arguments, name.replace("-", "_")) for name in _OPTIONS}
    options = ImportOptions.from_text({name: value for name, value in said.items() if value is not None})
    try:
        content = arguments.file.read_bytes()
    except OSError as error:
        raise InvalidFloorPlanError(f"'{arguments.file}' cannot be read: {error.strerror}") from error
    return import_plans(content, options)


def _anchor(text: str) -> Any:
    from lalaloc_core.plans import Anchor

    try:
        numbers = [float(part) for part in text.split(",")]
        latitude, longitude = numbers[:2]
        north_deg = numbers[2] if len(numbers) > 2 else 0.0
    except (ValueError, IndexError) as error:
        raise InvalidFloorPlanError(f"anchor is '{text[:50]}', it must be latitude,longitude[,north_deg]") from error
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(north_deg) <= 360.0) or len(numbers) > 3:
        raise InvalidFloorPlanError(f"anchor is '{text[:50]}', latitude lies within ±90, longitude within ±180")
    return Anchor(latitude, longitude, north_deg=north_deg)
