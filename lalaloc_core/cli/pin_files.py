"""Files of `lalaloc pin`: JSON, CSV, GeoJSON, maps, the report, and copies of the photographs with their place."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lalaloc_core.cli.answer_files import unread
from lalaloc_core.cli.plan_files import write_text
from lalaloc_core.errors import InvalidInputError, InvalidPhotographError
from lalaloc_core.localise.album.pins import Album, Pin, PinPose, moved_pins

if TYPE_CHECKING:
    from lalaloc_core.draw.pin_report import ReportRow
    from lalaloc_core.floorplan import FloorPlan

_VERSION = 1
_COLUMNS = (
    "number",
    "photograph",
    "taken",
    "plan",
    "room",
    "x_m",
    "y_m",
    "heading_deg",
    "confidence",
    "state",
    "reason",
)
COPIES = "photographs"


@dataclass(frozen=True, eq=False)
class PinnedFile:
    """A file of the folder.

    Attributes:
        number: number in the report, from 1.
        path: the file.
        id: id of its photograph; the same for copies of one file. None if it cannot be read, for `reason`.
        taken: when it was taken, as text; empty if unknown.
    """

    number: int
    path: Path
    id: str | None
    reason: str = ""
    taken: str = ""


def pins_document(
    plans: Sequence[FloorPlan],
    ids: Sequence[str],
    album: Album,
    files: Sequence[PinnedFile],
    notes: Sequence[str],
    moved: Sequence[str],
) -> dict[str, Any]:
    """Return everything that was found as JSON."""
    pins, counts = {pin.photograph_id: pin for pin in album.pins}, album.counts
    return {
        "version": _VERSION,
        "plans": [{"id": id, "name": plan.name} for id, plan in zip(ids, plans, strict=True)],
        "counts": {**counts, "set_aside": counts["set_aside"] + sum(file.id is None for file in files)},
        "camera_height_m": album.camera_height_m,
        "scale": album.scale,
        "cameras": [
            {
                "make": camera.make,
                "model": camera.model,
                "photographs": camera.photographs,
                "hfov_deg": math.degrees(camera.hfov),
                "hfov_std_deg": math.degrees(camera.hfov_sd),
            }
            for camera in album.cameras
        ],
        "photographs": [_entry(file, None if file.id is None else pins[file.id]) for file in files],
        "moved": list(moved),
        "notes": list(notes),
    }


def _entry(file: PinnedFile, pin: Pin | None) -> dict[str, Any]:
    head = {"number": file.number, "photograph": file.path.name, "sha256": file.id, "taken": file.taken or None}
    if pin is None:
        return {**head, **_pose_fields(None), "confidence": 0.0, "state": "set_aside", "reason": file.reason}
    suggestions = [{**_pose_fields(row.pose), "probability": row.probability} for row in pin.suggestions]
    rooms = [{"plan": row.plan_id, "room": row.room, "probability": row.probability} for row in pin.rooms]
    return {
        **head,
        **_pose_fields(pin.pose),
        "confidence": pin.confidence,
        "state": pin.state,
        "reason": pin.reason,
        "rooms": rooms,
        "suggestions": suggestions,
        "warnings": list(pin.warnings),
    }


def _pose_fields(pose: PinPose | None) -> dict[str, Any]:
    if pose is None:
        return {"plan": None, "room_id": None, "room": None, "position": None, "heading_deg": None}
    return {
        "plan": pose.plan_id,
        "room_id": pose.room_id,
        "room": pose.room,
        "position": {"x_m": pose.x_m, "y_m": pose.y_m},
        "heading_deg": pose.heading_deg,
    }


def read_previous(path: Path) -> list[Pin]:
    """Read the pins of an earlier run."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return [_pin_of(entry) for entry in document["photographs"] if entry["sha256"] is not None]
    except OSError as error:
        raise InvalidInputError(f"'{path}' cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InvalidInputError(f"'{path}' is not the pins.json of an earlier `lalaloc pin`") from error


def _pin_of(entry: dict[str, Any]) -> Pin:
    pose = None
    if entry["room"] is not None:
        heading = entry["heading_deg"]
        pose = PinPose(
            plan_id=str(entry["plan"]),
            room_id=str(entry["room_id"]),
            room=str(entry["room"]),
            x_m=float(entry["position"]["x_m"]),
            y_m=float(entry["position"]["y_m"]),
            heading=None if heading is None else math.radians(heading),
        )
    state, confidence = entry["state"], float(entry["confidence"])
    return Pin(photograph_id=str(entry["sha256"]), state=state, pose=pose, confidence=confidence, within_1m=0.0)


def moved_lines(before: Sequence[Pin], after: Sequence[Pin], files: Sequence[PinnedFile]) -> list[str]:
    """Return a sentence on each pin that moved by more than 0.5 m or changed its room."""
    names = {file.id: file.path.name for file in files}
    lines = []
    for moved in moved_pins(before, after):
        old, new = ("set aside" if pose is None else f"in '{pose.room}'" for pose in (moved.before, moved.after))
        distance = "" if moved.distance_m is None else f", {moved.distance_m:.1f} m away"
        change = f"was {old}, is now {new}{distance}" if moved.new_room else f"moved by {moved.distance_m:.1f} m {new}"
        lines.append(f"'{names[moved.photograph_id]}' {change}")
    return lines or ["no pin moved by more than 0.5 m or changed its room"]


def write_pin_files(
    out: Path,
    plans: Sequence[FloorPlan],
    ids: Sequence[str],
    album: Album,
    files: Sequence[PinnedFile],
    document: dict[str, Any],
    *,
    copies: bool,
) -> list[str]:
    """Write all files; return notes on what could not be written, which `document` gets as well.

    Raises:
        OSError: a file cannot be written.
    """
    from lalaloc_core.draw.pdf import write_pdf
    from lalaloc_core.draw.pin_report import DPI, report_pages
    from lalaloc_core.draw.pins import draw_pins

    entries, notes = document["photographs"], list[str]()
    if all(plan.anchor is None for plan in plans):
        notes.append("the plan has no anchor (docs/reference/plan-format.md), so pins.geojson is left out")
    else:
        write_text(out / "pins.geojson", json.dumps(_collection(plans, ids, entries)) + "\n")
    copied = _write_copies(out / COPIES, plans, ids, files, entries) if copies else []
    notes += copied
    document["notes"] += notes
    write_text(out / "pins.json", json.dumps(document, indent=2) + "\n")
    write_text(out / "pins.csv", _csv(entries))
    rows = list(_report_rows(ids, files, entries))
    for number, plan in enumerate(plans):
        name = "plan.svg" if len(plans) == 1 else f"plan-{number + 1}.svg"
        write_text(out / name, draw_pins(plan, [row.pin for row in rows if row.pin and row.plan == number]))
    title = " / ".join(dict.fromkeys(plan.name for plan in plans))
    write_pdf(report_pages(title, plans, rows, _summary(document, copied)), out / "report.pdf", DPI)
    return notes


def _summary(document: dict[str, Any], copied: Sequence[str]) -> list[str]:
    counts, lines = document["counts"], []
    lines.append(", ".join(f"{count} {state.replace('_', ' ')}" for state, count in counts.items() if count))
    if document["camera_height_m"] is not None:
        lines.append(f"Cameras were {document['camera_height_m']:.2f} m above the floor.")
    return [*lines, *copied]


def _csv(entries: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(_COLUMNS)
    for entry in entries:
        position, heading = entry["position"], entry["heading_deg"]
        place = ["", ""] if position is None else [f"{position['x_m']:.3f}", f"{position['y_m']:.3f}"]
        writer.writerow(
            [
                entry["number"],
                unread(entry["photograph"]),
                entry["taken"] or "",
                unread(entry["plan"] or ""),
                unread(entry["room"] or ""),
                *place,
                "" if heading is None else f"{heading:.1f}",
                f"{entry['confidence']:.4f}",
                entry["state"],
                unread(entry["reason"]),
            ]
        )
    return text.getvalue()


def _on_earth(plan: FloorPlan, entry: dict[str, Any]) -> tuple[float, float, float | None] | None:
    """Return latitude, longitude and azimuth from true north (degrees); None without an anchor."""
    if plan.anchor is None:
        return None
    place = entry["position"]["x_m"], entry["position"]["y_m"]
    ((longitude, latitude),) = plan.anchor.to_earth(np.array([place])).tolist()
    heading = entry["heading_deg"]
    return latitude, longitude, None if heading is None else plan.anchor.true_azimuth_deg(place, heading)


def _collection(plans: Sequence[FloorPlan], ids: Sequence[str], entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the pins as a GeoJSON FeatureCollection (RFC 7946)."""
    features = []
    for entry in entries:
        place = None if entry["plan"] is None else _on_earth(plans[ids.index(entry["plan"])], entry)
        if place is None:
            continue
        latitude, longitude, azimuth_deg = place
        names = ("number", "photograph", "taken", "plan", "room", "state")
        properties = {name: entry[name] for name in names} | {"confidence": round(entry["confidence"], 4)}
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": [round(longitude, 8), round(latitude, 8)]},
                "properties": properties | {"azimuth_deg": None if azimuth_deg is None else round(azimuth_deg, 2)},
            }
        )
    return {"type": "FeatureCollection", "features": features}


def _report_rows(
    ids: Sequence[str], files: Sequence[PinnedFile], entries: Sequence[dict[str, Any]]
) -> Iterator[ReportRow]:
    from lalaloc_core.draw.pin_report import ReportRow
    from lalaloc_core.draw.pins import DrawnPin

    for file, entry in zip(files, entries, strict=True):
        pin = None
        if entry["room"] is not None:
            position = entry["position"]
            pin = DrawnPin(
                number=file.number,
                x_m=position["x_m"],
                y_m=position["y_m"],
                heading_deg=entry["heading_deg"],
                state=entry["state"],
            )
        yield ReportRow(
            number=file.number,
            name=file.path.name,
            date=file.taken,
            plan=None if pin is None else ids.index(entry["plan"]),
            pin=pin,
            room=entry["room"] or "",
            room_key=f"{entry['plan']}/{entry['room_id']}",
            note=entry["reason"] if pin is None else f"{100.0 * entry['confidence']:.0f} % sure of the room",
            picture=partial(_thumbnail, file.path),
        )


def _thumbnail(path: Path) -> np.ndarray | None:
    from lalaloc_core.draw.pin_report import THUMBNAIL
    from lalaloc_core.photograph.photograph import open_picture

    try:
        return open_picture(path.read_bytes(), max_size=THUMBNAIL)
    except (InvalidPhotographError, OSError):
        return None


def _write_copies(
    folder: Path,
    plans: Sequence[FloorPlan],
    ids: Sequence[str],
    files: Sequence[PinnedFile],
    entries: Sequence[dict[str, Any]],
) -> list[str]:
    """Write copies of the photographs that have a pin."""
    from lalaloc_core.photograph.placed_copy import Place, placed_copy

    folder.mkdir(exist_ok=True)
    beside, written = 0, set[Path]()
    for file, entry in zip(files, entries, strict=True):
        if entry["room"] is None:
            continue
        plan = plans[ids.index(entry["plan"])]
        place = _on_earth(plan, entry)
        heading, north = entry["heading_deg"], plan.north
        direction_deg = None if place is None else place[2]
        if place is None and north is not None and heading is not None:
            direction_deg = (heading - math.degrees(north)) % 360.0
        stated = Place(
            room=entry["room"],
            level=plan.name,
            latitude=None if place is None else place[0],
            longitude=None if place is None else place[1],
            direction_deg=direction_deg,
        )
        copied = placed_copy(file.path.read_bytes(), stated)
        (folder / file.path.name).write_bytes(copied.content)
        if copied.sidecar is not None:
            beside += 1
            path = (folder / file.path.name).with_suffix(".xmp")
            # The name that all photo managers know; that with both suffixes for the second file of the same name.
            path = folder / f"{file.path.name}.xmp" if path in written else path
            path.write_bytes(copied.sidecar)
            written.add(path)
    return [f"copies with their place in an .xmp file beside them: {beside}"] if beside else []
