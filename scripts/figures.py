"""Tables of docs/results.md and docs/reference/paper-tables.md, from measured figures in docs/ and the manifest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.neighbours import markdown as markdown_of_neighbours
from lalaloc_core.evaluate.reproduce.result import TableResult, markdown
from lalaloc_core.evaluate.reproduce.tables import TABLES

ROOT = Path(__file__).resolve().parent.parent
BENCH = ROOT / "docs" / "bench.json"
NEIGHBOURS = ROOT / "docs" / "neighbours.json"
PAPER_TABLES = ROOT / "docs" / "tables"
MANIFEST = ROOT / "models" / "default" / "manifest.json"

_ACCURACY_ROWS = {
    "panorama_full": "furnished, known heading",
    "panorama_full_unknown_heading": "furnished, unknown heading",
    "panorama_empty": "unfurnished, known heading",
    "heldout_full": "out-of-distribution, furnished, known heading",
    "heldout_full_unknown_heading": "out-of-distribution, furnished, unknown heading",
    "heldout_empty": "out-of-distribution, unfurnished, known heading",
    "layout": "true layout as query, known heading",
}


def accuracy_table() -> str:
    """Return accuracy and calibration of the shipped model on synthetic homes as a Markdown table."""
    rows = [
        "| queries | < 1 m [95 %] | < 10 cm | median | heading < 2° | calibration error | n |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, title in _ACCURACY_ROWS.items():
        scores = _bench()["accuracy"][name]
        low, high = scores["within_1m_interval"]
        error = scores["expected_calibration_error"]
        median = f"{scores['median_cm']:.1f} cm" if scores["median_cm"] >= 0.01 else "< 0.01 cm"
        rows.append(
            _row(
                title,
                f"{_percent(scores['within_1m'])} [{100 * low:.0f}, {100 * high:.0f}]",
                _percent(scores["within_10cm"]),
                median,
                _percent(scores["heading_within_2deg"]),
                "–" if error is None else f"{error:.3f}",
                f"{scores['n']}",
            )
        )
    return "\n".join(rows)


def speed_table() -> str:
    """Return latency and memory of the service as a Markdown table."""
    service = _bench()["service"]
    memory = ", ".join(f"{size:.0f} MB" for size in service["workers_resident_mb"])
    rows = [
        "| what | measured |",
        "|---|---|",
        *(_latency(heading, service) for heading in ("known", "unknown")),
        _row("memory: service with one plan; its LPO worker", f"{service['service_resident_mb']:.0f} MB; {memory}"),
        _row("model bundle", f"{_bundle_mb():.1f} MB"),
    ]
    return "\n".join(rows)


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


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _bench() -> dict[str, Any]:
    return json.loads(BENCH.read_text(encoding="utf-8"))


def _bundle_mb() -> float:
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    return sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6


def _latency(heading: str, service: dict[str, Any]) -> str:
    measured = service[f"{heading}_heading"]
    stages = measured["median_stage_ms"]
    parts = ", ".join(f"{name} {stages[name]:.0f}" for name in ("decode", "encode", "retrieve", "lpo"))
    return _row(
        f"`/localise`, {heading} heading, one client: p50, p95 (median of stages)",
        f"{measured['p50_ms']:.0f} ms, {measured['p95_ms']:.0f} ms ({parts} ms)",
    )
