"""Files of `lalaloc pin`: JSON, CSV, GeoJSON, maps, the report, and copies of the photographs with their place."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lalaloc_core.cli.answer_files import EarthPlace, csv_text, place_feature, place_on_earth
from lalaloc_core.cli.plan_files import write_file
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.shown_text import no_formula, probability_text

if TYPE_CHECKING:
    from lalaloc_core.draw.pins import ReportRow
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
    from lalaloc_core.draw.pdf import write_pdf
    from lalaloc_core.draw.pins import DPI, pins_svg, report_pages
    from lalaloc_core.draw.plan import plan_svg

    plans = dict(zip(pinned.plan_ids, pinned.plans, strict=True))
    document: dict[str, Any] = pinned.document() | {"moved": list(moved)}
    entries, notes = document["photographs"], document["notes"]
    if all(plan.anchor is None for plan in pinned.plans):
        notes.append("the plan has no anchor (docs/reference/plan-format.md), so pins.geojson is left out")
    else:
        write_file(out / "pins.geojson", json.dumps(_collection(plans, entries)) + "\n")
    copied = _write_copies(out / COPIES, plans, paths, entries) if copies else []
    notes += copied
    write_file(out / "pins.json", json.dumps(document, indent=2) + "\n")
    write_file(out / "pins.csv", csv_text(_COLUMNS, [[cell(entry) for cell in _COLUMNS.values()] for entry in entries]))
    rows = [_report_row(list(plans), path, entry) for path, entry in zip(paths, entries, strict=True)]
    for number, plan in enumerate(pinned.plans):
        name = "plan.svg" if len(plans) == 1 else f"plan-{number + 1}.svg"
        pins = [row.pin for row in rows if row.pin and row.plan == number]
        write_file(out / name, plan_svg(plan, over=pins_svg(plan, pins)))
    title = " / ".join(dict.fromkeys(plan.name for plan in pinned.plans))
    write_pdf(report_pages(title, pinned.plans, rows, _summary(document, copied)), out / "report.pdf", DPI)
    return document


def _summary(document: dict[str, Any], copied: Sequence[str]) -> list[str]:
    counts, lines = document["counts"], []
    lines.append(", ".join(f"{count} {state.replace('_', ' ')}" for state, count in counts.items() if count))
    if document["camera_height_m"] is not None:
        lines.append(f"Cameras were {document['camera_height_m']:.2f} m above the floor.")
    return [*lines, *copied]


def _on_earth(plan: FloorPlan, entry: dict[str, Any]) -> EarthPlace | None:
    return place_on_earth(plan, (entry["position"]["x_m"], entry["position"]["y_m"]), entry["heading_deg"])


def _collection(plans: Mapping[str, FloorPlan], entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the pins as a GeoJSON FeatureCollection (RFC 7946)."""
    features = []
    for entry in entries:
        place = None if entry["plan"] is None else _on_earth(plans[entry["plan"]], entry)
        if place is None:
            continue
        names = ("number", "photograph", "taken", "plan", "room", "state")
        properties = {name: entry[name] for name in names} | {"confidence": round(entry["confidence"], 4)}
        features.append(place_feature(place, properties))
    return {"type": "FeatureCollection", "features": features}


def _report_row(plan_ids: Sequence[str], path: Path, entry: dict[str, Any]) -> ReportRow:
    from lalaloc_core.draw.pins import DrawnPin, ReportRow

    pin = None
    if entry["room"] is not None:
        position = entry["position"]
        named = {name: entry[name] for name in ("number", "heading_deg", "state")}
        pin = DrawnPin(x_m=position["x_m"], y_m=position["y_m"], **named)
    return ReportRow(
        number=entry["number"],
        name=entry["photograph"],
        date=entry["taken"] or "",
        plan=None if pin is None else plan_ids.index(entry["plan"]),
        pin=pin,
        room=entry["room"] or "",
        room_key=f"{entry['plan']}/{entry['room_id']}",
        note=entry["reason"] if pin is None else f"{probability_text(entry['confidence'], 0)} sure of the room",
        picture=partial(_thumbnail, path),
    )


def _thumbnail(path: Path) -> np.ndarray | None:
    from lalaloc_core.draw.pins import THUMBNAIL
    from lalaloc_core.photograph.photograph import open_picture

    try:
        return open_picture(path.read_bytes(), max_size=THUMBNAIL)
    except (InvalidPhotographError, OSError):
        return None


def _write_copies(
    folder: Path, plans: Mapping[str, FloorPlan], paths: Sequence[Path], entries: Sequence[dict[str, Any]]
) -> list[str]:
    """Write copies of the photographs that have a pin."""
    from lalaloc_core.photograph.placed_copy import Place, placed_copy

    folder.mkdir(exist_ok=True)
    beside, written = 0, set[Path]()
    for source, entry in zip(paths, entries, strict=True):
        if entry["room"] is None:
            continue
        plan = plans[entry["plan"]]
        place = _on_earth(plan, entry)
        heading, north = entry["heading_deg"], plan.north
        direction_deg = None if place is None else place.azimuth_deg
        if place is None and north is not None and heading is not None:
            direction_deg = (heading - math.degrees(north)) % 360.0
        stated = Place(
            room=entry["room"],
            level=plan.name,
            latitude=None if place is None else place.latitude,
            longitude=None if place is None else place.longitude,
            direction_deg=direction_deg,
        )
        copied, sidecar = placed_copy(source.read_bytes(), stated)
        (folder / source.name).write_bytes(copied)
        if sidecar is not None:
            beside += 1
            path = (folder / source.name).with_suffix(".xmp")
            # The name that all photo managers know; that with both suffixes for the second file of the same name.
            path = folder / f"{source.name}.xmp" if path in written else path
            path.write_bytes(sidecar)
            written.add(path)
    return [f"copies with their place in an .xmp file beside them: {beside}"] if beside else []
