"""Files of `lalaloc pin`: JSON, CSV, GeoJSON, maps, the report, and copies of the photographs with their place."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.answer_files import csv_text, place_feature
from lalaloc_core.cli.plan_files import write_file
from lalaloc_core.shown_text import no_formula

if TYPE_CHECKING:
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.localise.answers.pinned import PinnedAlbum

_COLUMNS: Mapping[str, Callable[[dict[str, Any]], object]] = {
    "number": lambda entry: entry["number"],
    "photograph": lambda entry: no_formula(entry["photograph"]),
    "taken": lambda entry: entry["taken"] or "",
    "plan": lambda entry: no_formula(entry["plan"] or ""),
    "room": lambda entry: no_formula(entry["room"] or ""),
    "x_m": lambda entry: "" if entry["position"] is None else f"{entry['position']['x_m']:.3f}",
    "y_m": lambda entry: "" if entry["position"] is None else f"{entry['position']['y_m']:.3f}",
    "heading_deg": lambda entry: "" if entry["heading_deg"] is None else f"{entry['heading_deg']:.1f}",
    "confidence": lambda entry: f"{entry['confidence']:.4f}",
    "state": lambda entry: entry["state"],
    "reason": lambda entry: no_formula(entry["reason"]),
    "room_confidence": lambda entry: f"{entry['room_confidence']:.4f}",
    "within_1m": lambda entry: f"{entry['within_1m']:.4f}",
}
COPIES = "photographs"


def write_pin_files(
    out: Path, pinned: PinnedAlbum, paths: Sequence[Path], moved: Sequence[str], *, copies: bool
) -> dict[str, Any]:
    """Write all files of an album of the photographs at `paths`; return the content of `pins.json`.

    Raises:
        OSError: a file cannot be written.
    """
    from lalaloc_core.draw.pdf import draw_pdf
    from lalaloc_core.draw.pins import DPI, ReportRow, draw_pins, report_notes, report_pages
    from lalaloc_core.draw.plan import extent_m, plan_svg

    plans = dict(zip(pinned.plan_ids, pinned.plans, strict=True))
    document: dict[str, Any] = pinned.document() | {"moved": list(moved)}
    entries, notes = document["photographs"], document["notes"]
    if all(plan.anchor is None for plan in pinned.plans):
        notes.append("the plan has no anchor (docs/reference/plan-format.md), so pins.geojson is left out")
    else:
        _write(out / "pins.geojson", json.dumps(_collection(plans, entries)) + "\n")
    copied = _write_copies(out / COPIES, plans, paths, entries) if copies else []
    notes += copied
    _write(out / "pins.json", json.dumps(document, indent=2) + "\n")
    _write(out / "pins.csv", csv_text(_COLUMNS, [[cell(entry) for cell in _COLUMNS.values()] for entry in entries]))
    rows = [ReportRow(entry, path.read_bytes) for path, entry in zip(paths, entries, strict=True)]
    for number, (plan_id, plan) in enumerate(plans.items()):
        name = "plan.svg" if len(plans) == 1 else f"plan-{number + 1}.svg"
        pins = [row.pin for row in rows if row.pin and row.entry["plan"] == plan_id]
        _write(out / name, plan_svg(plan, over=draw_pins(extent_m(plan), pins)))
    title = " / ".join(dict.fromkeys(plan.name for plan in pinned.plans))
    lines = [*report_notes(document["counts"], document["camera_height_m"], pinned.album.warnings), *copied]
    _write(out / "report.pdf", draw_pdf(report_pages(title, plans, rows, lines), DPI))
    return document


def _write(path: Path, content: str | bytes) -> None:
    """Write a file anew, as an earlier one can be a link to an original."""
    path.unlink(missing_ok=True)
    write_file(path, content)


def _collection(plans: Mapping[str, FloorPlan], entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the pins as a GeoJSON FeatureCollection (RFC 7946)."""
    features = []
    for entry in entries:
        plan = plans.get(entry["plan"])
        if plan is None or plan.anchor is None:
            continue
        properties = {name: entry[name] for name in ("number", "photograph", "taken", "plan", "room", "state")}
        properties |= {name: round(entry[name], 4) for name in ("room_confidence", "confidence", "within_1m")}
        features.append(place_feature(plan.anchor, entry, properties))
    return {"type": "FeatureCollection", "features": features}


def _write_copies(
    folder: Path, plans: Mapping[str, FloorPlan], paths: Sequence[Path], entries: Sequence[dict[str, Any]]
) -> list[str]:
    """Write copies of the photographs that have a pin."""
    from lalaloc_core.localise.answers.pinned import stated_place
    from lalaloc_core.photograph.placed_copy import placed_copy, sidecar_name

    folder.mkdir(exist_ok=True)
    beside = set[str]()
    for source, entry in zip(paths, entries, strict=True):
        if entry["room"] is None:
            continue
        plan = plans[entry["plan"]]
        copied, sidecar = placed_copy(source.read_bytes(), stated_place(entry, plan, plan.anchor))
        _write(folder / source.name, copied)
        if sidecar is not None:
            name = sidecar_name(source.name, beside)
            _write(folder / name, sidecar)
            beside.add(name.casefold())
    return [f"copies with their place in an .xmp file beside them: {len(beside)}"] if beside else []
