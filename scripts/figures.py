"""The tables of docs/results.md and the README, made from what `lalaloc bench`, `lalaloc reproduce` and the shipped
manifest say.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lalaloc_core.reproduce.render import markdown
from lalaloc_core.reproduce.result import TableResult
from lalaloc_core.reproduce.tables import TABLES

ROOT = Path(__file__).resolve().parent.parent
BENCH = ROOT / "docs" / "bench.json"
PAPER_TABLES = ROOT / "docs" / "tables"
MANIFEST = ROOT / "models" / "default" / "manifest.json"


def figures_table() -> str:
    """Every figure with its target, as a Markdown table."""
    bench = json.loads(BENCH.read_text(encoding="utf-8"))
    rendering, service = bench["rendering"], bench["service"]
    rows = [
        "| what | aim | measured |",
        "|---|---|---|",
        _row(
            "layout depth 128x256, closed form, per pose in a batch of 200",
            "≤ 0.5 ms",
            f"{rendering['layout_depth_128x256_ms_per_pose']:.2f} ms; trimesh + embree in the same run "
            f"{rendering['oracle_128x256_ms_per_pose']:.1f} ms, "
            f"{rendering['oracle_to_closed_form_ratio']:.0f} times as long",
        ),
        _row(
            "latent grid of a 100 m² home at 0.5 m",
            "≤ 1 s",
            f"{rendering['grid_seconds']:.2f} s ({rendering['grid_area_m2']:.0f} m², {rendering['grid_poses']} poses)",
        ),
        _latency("known", service["known_heading"], "≤ 250 ms", service["requests"]),
        _latency("unknown", service["unknown_heading"], "≤ 400 ms", service["requests"]),
        _row(
            "service process, resident memory with one plan",
            "≤ 500 MB",
            f"{service['service_resident_mb']:.0f} MB, besides its LPO worker with "
            + ", ".join(f"{size:.0f} MB" for size in service["workers_resident_mb"]),
        ),
        *_accuracy_rows(bench["accuracy"]),
        *_comparison_rows(bench["methods"], bench["datasets"]),
    ]
    return "\n".join(rows)


def paper_tables() -> str:
    """Every table of the paper with our figures beside the paper's, as Markdown."""
    return "\n".join(markdown(TableResult.read(PAPER_TABLES / f"{table.name}.json")) for table in TABLES).rstrip()


def training_table() -> str:
    """How the shipped model came to be, from its manifest."""
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    training = manifest["training"]
    size = sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6
    rows = [
        "| | |",
        "|---|---|",
        _row("model", f"`{manifest['name']}` {manifest['version']}, architecture `{manifest['architecture']}`"),
        _row("bundle", f"{size:.1f} MB"),
        _row("hardware", training["hardware"]),
        _row("stage 1", f"{training['layout']['minutes']} minutes, {training['layout']['steps']} steps"),
        _row(
            "stage 2",
            f"{training['image']['minutes']} minutes, {training['image']['steps']} steps, "
            f"{training['image']['panoramas']:,} panoramas, each seen once",
        ),
        _row("export", f"largest difference from torch {training['parity_max_abs_difference']:.1e}"),
    ]
    return "\n".join(rows)


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _latency(heading: str, measured: dict[str, Any], aim: str, requests: int) -> str:
    stages = measured["median_stage_ms"]
    parts = ", ".join(f"{name} {stages[name]:.0f}" for name in ("decode", "encode", "retrieve", "vdr", "lpo"))
    return _row(
        f"`/localise`, {heading} heading, full refinement, p50, one client",
        aim,
        f"{measured['p50_ms']:.0f} ms (p95 {measured['p95_ms']:.0f} ms, {requests} requests; medians: {parts} ms)",
    )


def _accuracy_rows(accuracy: dict[str, Any]) -> list[str]:
    layout, full = accuracy["layout"], accuracy["panorama_full"]
    empty, unknown = accuracy["panorama_empty"], accuracy["panorama_full_unknown_heading"]
    return [
        _row("layout queries, VDR + LPO", "≥ 85 % < 1 cm; median ≤ 0.2 cm", _accuracy(layout)),
        _row("panorama queries, furnished", "≥ 50 % < 1 m, ≥ 33 % < 10 cm", _accuracy(full)),
        _row("… the same, retrieval only", "", _accuracy({**full["retrieval"]})),
        _row("panorama queries, empty rooms", "", _accuracy(empty)),
        _row("panorama queries, furnished, heading unknown", "", _accuracy(unknown)),
        _row(
            "confidence, expected calibration error for “within 1 m”",
            "",
            f"{full['expected_calibration_error']:.3f} with known heading, "
            f"{unknown['expected_calibration_error']:.3f} with unknown heading",
        ),
    ]


def _comparison_rows(methods: dict[str, Any], datasets: dict[str, Any]) -> list[str]:
    return [
        _row(
            f"2D ICP in a home of {methods['area_m2']:.0f} m², one query, one thread",
            "the paper: 20.1 s, 4.3 times as long as LaLaLoc",
            f"{methods['icp_seconds']:.1f} s; LaLaLoc in the same run {methods['lalaloc_seconds']:.2f} s, "
            f"{methods['icp_to_lalaloc_ratio']:.0f} times as long",
        ),
        _row(
            "reading scenes in Structured3D's layout, two processes",
            "≥ 50 scenes/s",
            f"{datasets['scenes_read_per_second']:.0f} scenes/s",
        ),
        _row(
            "writing synthetic panoramas of 256x512, two processes",
            "≥ 10 panoramas/s",
            f"{datasets['panoramas_written_per_second']:.0f} panoramas/s (n = {datasets['panoramas_written']:,})",
        ),
        _row(
            f"evaluating {datasets['queries']} panoramas, all stages, two processes",
            "≤ 120 s",
            f"{datasets['evaluation_seconds']:.0f} s",
        ),
    ]


def _accuracy(scores: dict[str, Any]) -> str:
    median = "under 0.01" if scores["median_cm"] < 0.01 else f"{scores['median_cm']:.1f}"
    return (
        f"{scores['within_1m']:.1%} < 1 m, {scores['within_10cm']:.1%} < 10 cm, {scores['within_1cm']:.1%} < 1 cm, "
        f"median {median} cm (n = {scores['n']})"
    )
