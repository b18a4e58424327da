"""The tables of docs/results.md and the README, made from what `lalaloc bench`, `lalaloc reproduce` and the shipped
manifest say.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lalaloc_core.evaluate.reproduce.result import TableResult, markdown
from lalaloc_core.evaluate.reproduce.tables import TABLES

ROOT = Path(__file__).resolve().parent.parent
BENCH = ROOT / "docs" / "bench.json"
PAPER_TABLES = ROOT / "docs" / "tables"
MANIFEST = ROOT / "models" / "default" / "manifest.json"


def figures_table() -> str:
    """Every figure with the paper's and its aim, as a Markdown table."""
    bench = _bench()
    rendering, service = bench["rendering"], bench["service"]
    rows = [
        "| what | the paper, on Structured3D | aim, and beyond | ours, on synthetic homes |",
        "|---|---|---|---|",
        *_accuracy_rows(bench["accuracy"]),
        _latency("known", service["known_heading"], "4.65 s on a GPU", "≤ 200 ms, ≤ 100 ms", service["requests"]),
        _latency("unknown", service["unknown_heading"], "", "≤ 400 ms", service["requests"]),
        _row("model bundle", "", "≤ 25 MB", f"{_bundle_mb():.1f} MB"),
        _row(
            "service process, resident memory with one plan",
            "",
            "≤ 500 MB",
            f"{service['service_resident_mb']:.0f} MB, besides its LPO worker with "
            + ", ".join(f"{size:.0f} MB" for size in service["workers_resident_mb"]),
        ),
        _row(
            "latent grid of a 100 m² home at 0.5 m",
            "",
            "≤ 1 s",
            f"{rendering['grid_seconds']:.2f} s ({rendering['grid_area_m2']:.0f} m², {rendering['grid_poses']} poses)",
        ),
        _row(
            "layout depth 128x256, closed form, per pose in a batch of 200",
            "",
            "≤ 0.5 ms",
            f"{rendering['layout_depth_128x256_ms_per_pose']:.2f} ms; trimesh + embree in the same run "
            f"{rendering['oracle_128x256_ms_per_pose']:.1f} ms, "
            f"{rendering['oracle_to_closed_form_ratio']:.0f} times as long",
        ),
        *_comparison_rows(bench["methods"], bench["datasets"]),
    ]
    return "\n".join(rows)


def evidence_table() -> str:
    """What poses are compared by, as a Markdown table."""
    rows = [
        "| heading | compared by | retrieval < 1 m | < 1 m | < 10 cm | median | n |",
        "|---|---|---|---|---|---|---|",
    ]
    for heading, compared in _bench()["evidence"].items():
        for name, scores in compared.items():
            cells = [f"{scores['retrieval']['within_1m']:.1%}", f"{scores['within_1m']:.1%}"]
            cells += [f"{scores['within_10cm']:.1%}", f"{scores['median_cm']:.1f} cm", f"{scores['n']}"]
            rows.append(_row(heading.removesuffix("_heading"), name, *cells))
    return "\n".join(rows)


def paper_tables() -> str:
    """Every table of the paper with our figures beside the paper's, as Markdown."""
    return "\n".join(markdown(TableResult.read(PAPER_TABLES / f"{table.name}.json")) for table in TABLES).rstrip()


def training_table() -> str:
    """How the shipped model came to be, from its manifest."""
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    training = manifest["training"]
    layout, image = training["layout"], training["image"]
    begun = image.get("begun_from") or layout["begun_from"]
    rows = [
        "| | |",
        "|---|---|",
        _row("model", f"`{manifest['name']}` {manifest['version']}, architecture `{manifest['architecture']}`"),
        _row("hardware", training["hardware"]),
        _row("command", f"`{training['command']}`"),
        _row("stage 1", f"that of version {begun['version']}: {layout['minutes_in_all']:g} minutes"),
        _row("stage 2", _second_stage(image)),
        _row(
            "in all",
            f"{image.get('panoramas_in_all', image['panoramas']):,} panoramas, "
            f"{image.get('minutes_in_all', image['minutes']):g} minutes",
        ),
        _row("weights", image["checkpoint"]),
        _row("export", f"largest difference from torch {training['parity_max_abs_difference']:.1e}"),
    ]
    return "\n".join(rows)


def _second_stage(image: dict[str, Any]) -> str:
    """What the image encoder began with, and for how long it was trained."""
    trained = f"{image['steps']:,} steps in {image['minutes']:g} minutes on {image['panoramas']:,} new panoramas"
    begun = image.get("begun_from")
    if not begun:
        return f"begun with a trunk pretrained on ImageNet, {trained}"
    return (
        f"begun with version {begun['version']} ({begun['panoramas_in_all']:,} panoramas, "
        f"{begun['minutes_in_all']:g} minutes), then {trained}"
    )


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _bench() -> dict[str, Any]:
    return json.loads(BENCH.read_text(encoding="utf-8"))


def _bundle_mb() -> float:
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    return sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6


def _latency(heading: str, measured: dict[str, Any], paper: str, aim: str, requests: int) -> str:
    stages = measured["median_stage_ms"]
    parts = ", ".join(f"{name} {stages[name]:.0f}" for name in ("decode", "encode", "retrieve", "vdr", "lpo"))
    return _row(
        f"`/localise`, {heading} heading, full refinement, p50, one client, 2 cores",
        paper,
        aim,
        f"{measured['p50_ms']:.0f} ms (p95 {measured['p95_ms']:.0f} ms, {requests} requests; medians: {parts} ms)",
    )


def _accuracy_rows(accuracy: dict[str, Any]) -> list[str]:
    full, unknown = accuracy["panorama_full"], accuracy["panorama_full_unknown_heading"]
    outside, layout = accuracy["out_of_family_full"], accuracy["layout"]
    return [
        _row("furnished, median error", "8.3 cm", "≤ 8 cm, ≤ 5 cm", _median(full)),
        _row("furnished, < 10 cm", "58.0 %", "≥ 58 %, ≥ 75 %", _share(full, "within_10cm")),
        _row("furnished, < 1 m", "87.5 %", "≥ 88 %, ≥ 93 %", _share(full, "within_1m")),
        _row("… by retrieval alone, < 1 m", "", "", f"{full['retrieval']['within_1m']:.1%}"),
        _row("unfurnished, median error", "5.7 cm", "≤ 5 cm, ≤ 3 cm", _median(accuracy["panorama_empty"])),
        _row("unfurnished, < 1 m", "", "", _share(accuracy["panorama_empty"], "within_1m")),
        _row("furnished, heading unknown, < 1 m", "", "≥ 75 %, ≥ 88 %", _share(unknown, "within_1m")),
        _row("… its heading within 2°", "", "", f"{unknown['heading_within_2deg']:.1%}"),
        _row("out-of-family, furnished, < 1 m", "", "≥ 70 %, ≥ 85 %", _share(outside, "within_1m")),
        _row("out-of-family, furnished, median error", "", "", _median(outside)),
        _row("out-of-family, unfurnished, < 1 m", "", "", _share(accuracy["out_of_family_empty"], "within_1m")),
        _row("layout queries, < 1 cm", "69.1 % (ICP 87.9 %)", "≥ 90 %, ≥ 98 %", _share(layout, "within_1cm")),
        _row("layout queries, < 1 m", "94.9 % (ICP 99.9 %)", "≥ 95 %, ≥ 99 %", _share(layout, "within_1m")),
        _row(
            "confidence, expected calibration error for “within 1 m”",
            "",
            "≤ 0.05, ≤ 0.03",
            f"{full['expected_calibration_error']:.3f}; heading unknown {unknown['expected_calibration_error']:.3f}, "
            f"out-of-family {outside['expected_calibration_error']:.3f}",
        ),
    ]


def _comparison_rows(methods: dict[str, Any], datasets: dict[str, Any]) -> list[str]:
    return [
        _row(
            f"2D ICP in a home of {methods['area_m2']:.0f} m², one query, one thread",
            "20.1 s, 4.3 times as long as LaLaLoc",
            "",
            f"{methods['icp_seconds']:.1f} s; LaLaLoc in the same run {methods['lalaloc_seconds']:.2f} s, "
            f"{methods['icp_to_lalaloc_ratio']:.0f} times as long",
        ),
        _row(
            "reading scenes in Structured3D's layout, two processes",
            "",
            "≥ 50 scenes/s",
            f"{datasets['scenes_read_per_second']:.0f} scenes/s",
        ),
        _row(
            "writing synthetic panoramas of 256x512, two processes",
            "",
            "≥ 10 panoramas/s",
            f"{datasets['panoramas_written_per_second']:.0f} panoramas/s (n = {datasets['panoramas_written']:,})",
        ),
        _row(
            f"evaluating {datasets['queries']} panoramas, all stages, two processes",
            "",
            "≤ 120 s",
            f"{datasets['evaluation_seconds']:.0f} s",
        ),
    ]


def _median(scores: dict[str, Any]) -> str:
    median = "under 0.01" if scores["median_cm"] < 0.01 else f"{scores['median_cm']:.1f}"
    return f"{median} cm (n = {scores['n']:,})"


def _share(scores: dict[str, Any], name: str) -> str:
    return f"{scores[name]:.1%} (n = {scores['n']:,})"
