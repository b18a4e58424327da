"""Tables of the documentation, from measured figures in docs/ and the manifest."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.neighbours import markdown as markdown_of_neighbours
from lalaloc_core.conditions import CONDITIONS, parts_of
from lalaloc_core.evaluate.reproduce.paper_tables import TABLES
from lalaloc_core.evaluate.reproduce.table import TableResult, markdown

ROOT = Path(__file__).resolve().parent.parent
BENCH = ROOT / "docs" / "bench.json"
NEIGHBOURS = ROOT / "docs" / "neighbours.json"
PAPER_TABLES = ROOT / "docs" / "tables"
MANIFEST = ROOT / "models" / "default" / "manifest.json"

_ACCURACY_ROWS = {
    "sphere_full": "furnished, known heading",
    "sphere_full_unknown_heading": "furnished, unknown heading",
    "sphere_empty": "unfurnished, known heading",
    "heldout_full": "out-of-distribution, furnished, known heading",
    "heldout_full_unknown_heading": "out-of-distribution, furnished, unknown heading",
    "layout": "true layout as query, known heading",
}
_PHOTOGRAPHS = {"sphere": "sphere", "phone": "80°", "three_phone": "three of 80°"}


def accuracy_table() -> str:
    """Return accuracy and calibration of the shipped model on synthetic homes as a Markdown table."""
    rows = []
    for name, title in _ACCURACY_ROWS.items():
        scores = _bench()["accuracy"][name]
        error = scores["expected_calibration_error"]
        median = f"{scores['median_cm']:.1f} cm" if scores["median_cm"] >= 0.01 else "< 0.01 cm"
        rows.append(
            (
                title,
                _share_and_interval(scores),
                _percent(scores["within_10cm"]),
                median,
                _percent(scores["heading_within_2deg"]),
                "–" if error is None else f"{error:.3f}",
                f"{scores['n']}",
            )
        )
    return table("queries | < 1 m [95 %] | < 10 cm | median | heading < 2° | calibration error | n", rows)


_TERM_ROWS = {
    "all": "all",
    "without_openings": "without openings",
    "without_see_through": "without seeing through openings",
    "without_ceiling": "without ceilings",
    "without_room_type": "without room types",
    "walls_alone": "walls alone",
}


def terms_table() -> str:
    """Return the share within 1 m with and without terms of the matching cost as a Markdown table."""
    rows, homes = [], _bench()["terms"]
    for name, title in _TERM_ROWS.items():
        cells = (homes[split][name][heading] for split in homes for heading in ("known_heading", "unknown_heading"))
        rows.append((title, *(_percent(scores["within_1m"]) for scores in cells)))
    head = "terms | test, known heading | test, unknown | out-of-distribution, known | out-of-distribution, unknown"
    return table(head, rows)


_VIEW_ROWS = {
    "view_60_unknown_heading": "60°, unknown heading",
    "view_80_unknown_heading": "80°, unknown heading",
    "view_80_known_tilt": "80°, unknown heading, tilt stated",
    "view_80_unknown_field": "80°, unknown heading, nothing stated",
    "view_106_unknown_heading": "106°, unknown heading",
    "view_80_heading_within_10_deg": "80°, heading known within 10°",
    "heldout_view_80_unknown_heading": "out-of-distribution, 80°, unknown heading",
    "heldout_view_106_unknown_heading": "out-of-distribution, 106°, unknown heading",
}

_TURN_ROWS = {
    "known_angles": "three of 80° from one spot, known angles between them, unknown heading",
    "unknown_angles": "three of 80° from one spot, unknown angles",
}

_FILM_ROWS = {
    "stated": "twelve photographs of 53°, upright, angles stated",
    "overlap": "… angles from overlap",
    "overlap_unknown_field": "… angles from overlap, field of view unknown",
    "film": "hand-held film of 8 s, nothing stated",
}
_ANNOTATED_ROWS = {"annotated_sphere": "sphere of a real room", "annotated_film": "hand-held film of 8 s, cut from it"}

_UNINFORMATIVE_ROWS = {
    "blank_wall": "wall without openings, 50°",
    "ceiling": "ceiling, 80°, 60° upwards",
    "landscape": "drawn landscape, 80°",
}

_SPEED_ROWS = {
    "known_heading": "sphere, known heading",
    "unknown_heading": "sphere, unknown heading",
    "without_openings": "sphere, unknown heading, plan without openings",
    "phone": "photograph of 80° and 12 megapixels, unknown heading",
}


def _share_and_interval(scores: dict[str, Any]) -> str:
    low, high = scores["within_1m_interval"]
    return f"{_percent(scores['within_1m'])} [{100 * low:.0f}, {100 * high:.0f}]"


def views_table() -> str:
    """Return accuracy and calibration of views in furnished synthetic homes as a Markdown table."""
    rows = []
    for name, title in _VIEW_ROWS.items():
        scores = _bench()["views"][name]
        rows.append(
            (
                title,
                _share_and_interval(scores),
                _percent(scores["within_1m_30deg"]),
                _percent(scores["among_5"]),
                f"{scores['median_cm']:.0f} cm",
                f"{scores['expected_calibration_error']:.3f}",
                f"{scores['n']}",
            )
        )
    for name, title in _TURN_ROWS.items():
        scores = _bench()["turns"][name]
        shares = _percent(scores["within_1m"]), _percent(scores["within_1m_30deg"]), "–"
        error = f"{scores['expected_calibration_error']:.3f}"
        rows.append((title, *shares, f"{scores['median_cm']:.0f} cm", error, f"{scores['n']}"))
    head = "views of furnished homes | < 1 m [95 %] | < 1 m and 30° | among five | median | calibration error | n"
    return table(head, rows)


def films_table() -> str:
    """Return accuracy and calibration of turns and films in furnished synthetic homes as a Markdown table."""
    rows = []
    for name, title in _FILM_ROWS.items():
        found = _bench()["films"][name]
        angles = "–" if name == "stated" else f"{found['median_angle_error_deg']:.1f}°"
        field = f"{100 * found['median_field_error']:.1f} %" if name in ("overlap_unknown_field", "film") else "–"
        shares = _percent(found["within_1m"]), f"{found['median_cm']:.0f} cm", f"{found['mean_confidence']:.2f}"
        error = f"{found['expected_calibration_error']:.3f}"
        rows.append((title, *shares, error, angles, field, f"{found['n']}"))
    head = "turns in furnished homes, heading unknown | < 1 m | median | mean confidence | calibration error"
    return table(f"{head} | error of angles | of the field of view | n", rows)


def annotated_films_table() -> str:
    """Return the shares of films and spheres of real rooms that are located, as a Markdown table."""
    rows = []
    for name, title in _ANNOTATED_ROWS.items():
        found = _bench()["films"][name]
        shares = _percent(found["located"]), _percent(found["right_room"]), _percent(found["within_1m"])
        error = f"{found['expected_calibration_error']:.3f}"
        rows.append((title, *shares, f"{found['mean_confidence']:.2f}", error, f"{found['n']}"))
    head = "in plans of twenty rooms, heading unknown | located | right room | < 1 m | mean confidence"
    return table(f"{head} | calibration error | n", rows)


def uninformative_table() -> str:
    """Return the confidence of photographs that cannot tell the place as a Markdown table."""
    rows = []
    for name, title in _UNINFORMATIVE_ROWS.items():
        found = _bench()["uninformative"][name]
        values = _percent(found["above_half"]), f"{found['median']:.2f}", f"{found['highest']:.2f}", f"{found['n']}"
        rows.append((title, *values))
    return table("photograph | confidence above 0.5 | median | highest | n", rows)


def localisability_table() -> str:
    """Return predicted and found shares of photographs, as a Markdown table."""
    rows, group = [], _bench()["localisability"]
    for name in CONDITIONS:
        photograph, heading = parts_of(name)
        found = group[name]
        low, high = found["interval"]
        difference = f"{100 * (found['predicted'] - found['found']):.1f} [{100 * low:.1f}, {100 * high:.1f}]"
        shares = _percent(found["predicted"]), _percent(found["found"])
        rows.append((f"{_PHOTOGRAPHS[photograph]}, {heading}", *shares, difference, f"{group['n']}"))
    return table("photograph, heading | predicted | found | difference [95 %] | n", rows)


def speed_table() -> str:
    """Return latency and memory of the service as a Markdown table."""
    service = _bench()["service"]
    memory = ", ".join(f"{size:.0f} MB" for size in service["workers_resident_mb"])
    rows = [
        *(_latency(title, service[name]) for name, title in _SPEED_ROWS.items()),
        ("memory: service with one plan; its LPO worker", f"{service['service_resident_mb']:.0f} MB; {memory}"),
        ("model bundle", f"{_bundle_mb():.1f} MB"),
    ]
    return table("what | measured", rows)


def neighbours_table() -> str:
    """Return the latency of one tenant beside another as a Markdown table, with the command that measured it."""
    if not NEIGHBOURS.exists():
        return "Not measured with this version."
    report = json.loads(NEIGHBOURS.read_text(encoding="utf-8"))
    return f"`{report['command']}` on {report['cores']} cores:\n\n{markdown_of_neighbours(report)}"


def paper_tables() -> str:
    """Return the measured tables of the paper with our figures beside the paper's, as Markdown."""
    paths = [PAPER_TABLES / f"{table.name}.json" for table in TABLES]
    return "\n".join(markdown(TableResult.read(path)) for path in paths if path.exists()).rstrip()


def table(head: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the names of its columns are separated by " | "."""
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([f"| {head} |", f"|{'---|' * len(head.split(' | '))}", *lines])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _bench() -> dict[str, Any]:
    return json.loads(BENCH.read_text(encoding="utf-8"))


def _bundle_mb() -> float:
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    return sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6


def _latency(title: str, measured: dict[str, Any]) -> tuple[str, str]:
    stages = measured["median_stage_ms"]
    parts = ", ".join(f"{name} {stages[name]:.0f}" for name in ("decode", "encode", "retrieve", "lpo"))
    return (
        f"`/localise`, {title}, one client: p50, p95 (median of stages)",
        f"{measured['p50_ms']:.0f} ms, {measured['p95_ms']:.0f} ms ({parts} ms)",
    )
