"""Files with the answers for many photographs: CSV, GeoJSON and a map."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.plan_files import check_picture_name, write_file, write_picture
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.shown_text import no_formula

if TYPE_CHECKING:
    from lalaloc_core.draw.plan import Marker
    from lalaloc_core.floorplan import FloorPlan
    from lalaloc_core.floorplan.earth import Anchor

_COLUMNS = ("photograph", "room", "x_m", "y_m", "heading_deg", "within_95_m", "confidence", "error")


FILES = """
--csv FILE: write a table with a row per photograph
--geojson FILE: write the places on Earth, for a plan with an anchor
--map FILE: draw all places on the plan, .png or .svg
"""


def check_file_options(arguments: argparse.Namespace, plan: FloorPlan) -> None:
    """Refuse files that could not be written, before the work begins."""
    if arguments.map is not None:
        check_picture_name(arguments.map, "--map")
    if arguments.geojson is not None and plan.anchor is None:
        raise InvalidInputError(
            "--geojson needs places on Earth, which this plan has not: give it an anchor "
            "(docs/reference/plan-format.md), or use --csv"
        )


def write_files(
    arguments: argparse.Namespace,
    plan: FloorPlan,
    answers: Sequence[dict[str, Any]],
    places: Sequence[tuple[str, Marker]],
) -> None:
    """Write the files that the arguments name, of documents of answers, and of name and camera of those found."""
    from lalaloc_core.draw.plan_overlays import draw_places

    if arguments.csv is not None:
        rows = ([no_formula(a["photograph"]), *_cells(a), no_formula(a.get("error", ""))] for a in answers)
        write_file(arguments.csv, csv_text(_COLUMNS, rows))
    if arguments.geojson is not None:
        write_file(arguments.geojson, json.dumps(_collection(plan, answers)) + "\n")
    if arguments.map is not None:
        write_picture(draw_places(plan, places), arguments.map)


def csv_text(columns: Iterable[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def _cells(answer: dict[str, Any]) -> list[str]:
    from lalaloc_core.draw.answer import ellipse_m

    if "error" in answer:
        return [""] * (len(_COLUMNS) - 2)
    covariance, confidence = answer["covariance_m2"], answer["confidence"]
    within = ""
    if covariance is not None:
        (xx, xy), (_, yy) = covariance
        within = f"{ellipse_m((xx, xy, yy))[0]:.3f}"
    return [
        no_formula(answer["room"]),
        f"{answer['position']['x_m']:.3f}",
        f"{answer['position']['y_m']:.3f}",
        f"{answer['heading_deg']:.1f}",
        within,
        "" if confidence is None else f"{confidence:.4f}",
    ]


def place_feature(anchor: Anchor, answer: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    """Return the place of an answer or of a pin as a GeoJSON Feature (RFC 7946)."""
    position = answer["position"]
    latitude, longitude, azimuth_deg = anchor.place((position["x_m"], position["y_m"]), answer["heading_deg"])
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [round(longitude, 8), round(latitude, 8)]},
        "properties": properties | {"azimuth_deg": None if azimuth_deg is None else round(azimuth_deg, 2)},
    }


def _collection(plan: FloorPlan, answers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the places as a GeoJSON FeatureCollection (RFC 7946)."""
    assert plan.anchor is not None
    features = []
    for answer in answers:
        if "error" in answer:
            continue
        confidence = answer["confidence"]
        share = None if confidence is None else round(confidence, 4)
        properties = {"photograph": answer["photograph"], "room": answer["room"], "confidence": share}
        features.append(place_feature(plan.anchor, answer, properties))
    return {"type": "FeatureCollection", "features": features}
