"""Importing drawn floor plans: rooms, doors and windows found in pictures, by style and by condition.

`python -m benchmarks.plan_pictures` prints the figures of docs/results.md by style; `--conditions` those with noise,
shadow, furniture and as JPEG of 150 dpi; `--scale` the errors of scales that are estimated without any text;
`--symbols` the rooms and the precision and recall of fixtures, drawn as symbols among furniture.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import shapely

from benchmarks.plan_drawing import STYLES, DrawnPlan, OpeningSymbol, Style, draw_plan
from benchmarks.plan_symbols import FIXTURES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, import_plan

_IOU, _SYMBOL_IOU = 0.9, 0.6
# An imported opening matches when it overlaps the true one by half of the longer, at most this far (m) beside it.
_OVERLAP, _APART_M = 0.5, 0.3
Condition = Literal["clean", "noise, σ = 5", "shadow, 40 %", "noise and shadow", "furniture", "JPEG, 1:100 at 150 dpi"]
_SIGMA, _DARKEST, _PIXELS_PER_M_AT_150_DPI = 5.0, 0.6, 0.01 * 150.0 / 0.0254


@dataclass
class Score:
    """Counts over plans of one style."""

    rooms: int = 0
    rooms_found: int = 0
    rooms_imported: int = 0
    seconds: float = 0.0
    plans: int = 0
    door: tuple[int, int, int] = (0, 0, 0)
    window: tuple[int, int, int] = (0, 0, 0)

    @property
    def room_share(self) -> float:
        """Share of rooms found with an intersection over union of at least 0.9."""
        return self.rooms_found / max(self.rooms, 1)


def f1(counts: tuple[int, int, int]) -> float:
    """Return the F1 score of (true, imported, found)."""
    true, imported, found = counts
    return 2.0 * found / max(true + imported, 1)


def score_plan(drawn: DrawnPlan, content: bytes, score: Score) -> dict[str, Any]:
    """Import one picture, count the rooms and openings found, and return the plan; none where the import is refused."""
    began = time.process_time()
    try:
        document = import_plan(content, ImportOptions(metres_per_pixel=drawn.metres_per_pixel)).document
    except InvalidFloorPlanError:
        document = {"rooms": []}
    score.seconds += time.process_time() - began
    score.plans += 1
    imported = [shapely.Polygon(room["polygon"], room.get("holes")) for room in document["rooms"]]
    score.rooms += len(drawn.rooms)
    score.rooms_imported += len(imported)
    score.rooms_found += sum(any(_iou(room, candidate) >= _IOU for candidate in imported) for room in drawn.rooms)
    openings = document.get("openings", [])
    for kind in ("door", "window"):
        lines = [shapely.LineString(opening["line"]) for opening in openings if opening["kind"] == kind]
        truth = [opening for opening in drawn.openings if opening.kind == kind]
        counts = (len(truth), len(lines), _matches(truth, lines))
        setattr(score, kind, tuple(a + b for a, b in zip(getattr(score, kind), counts, strict=True)))
    return document


def _iou(a: shapely.Polygon, b: shapely.Polygon) -> float:
    shared = shapely.intersection(a, b).area
    return shared / (a.area + b.area - shared)


def _matches(truth: Sequence[OpeningSymbol], imported: Sequence[shapely.LineString]) -> int:
    unmatched = list(imported)
    found = 0
    for opening in truth:
        line = shapely.LineString([opening.start, opening.end])
        around = line.buffer(_APART_M, cap_style="flat")
        for candidate in unmatched:
            shared = shapely.intersection(around, candidate).length
            if shared >= _OVERLAP * max(line.length, candidate.length):
                unmatched.remove(candidate)
                found += 1
                break
    return found


def measure(style: Style, plans: int, first_seed: int = 0) -> Score:
    """Return the score of a number of generated plans of a style."""
    score = Score()
    for seed in range(first_seed, first_seed + plans):
        drawn = draw_plan(style, seed)
        score_plan(drawn, drawn.jpeg() if style == "scanned" else drawn.png(), score)
    return score


def measure_condition(condition: Condition, plans: int, first_seed: int = 0) -> Score:
    """Return the score of generated plans under a condition, over all styles that are no scans."""
    score = Score()
    for style in STYLES:
        for seed in range(first_seed, first_seed + plans if style != "scanned" else first_seed):
            is_jpeg = condition.startswith("JPEG")
            drawn = draw_plan(
                style,
                seed,
                is_furnished=condition == "furniture",
                pixels_per_m=_PIXELS_PER_M_AT_150_DPI if is_jpeg else None,
            )
            if "shadow" in condition:
                drawn = drawn.shaded(_DARKEST)
            if "noise" in condition:
                drawn = drawn.noisy(_SIGMA, seed)
            score_plan(drawn, drawn.jpeg() if is_jpeg else drawn.png(), score)
    return score


def measure_symbols(style: Style, plans: int, first_seed: int = 0) -> tuple[Score, dict[str, tuple[int, int, int]]]:
    """Return the score of plans with symbols, and by kind of fixture how many are drawn, imported, and both."""
    score = Score()
    counts: dict[str, tuple[int, int, int]] = dict.fromkeys(FIXTURES, (0, 0, 0))
    for seed in range(first_seed, first_seed + plans):
        drawn = draw_plan(style, seed, has_symbols=True)
        document = score_plan(drawn, drawn.jpeg() if style == "scanned" else drawn.png(), score)
        fixtures = [(entry["kind"], shapely.Polygon(entry["outline"])) for entry in document.get("fixtures", [])]
        for kind in FIXTURES:
            truth = [symbol.outline for symbol in drawn.symbols if symbol.kind == kind]
            found = [outline for name, outline in fixtures if name == kind]
            matched = sum(any(_iou(outline, other) >= _SYMBOL_IOU for other in truth) for outline in found)
            drawn_before, found_before, matched_before = counts[kind]
            counts[kind] = drawn_before + len(truth), found_before + len(found), matched_before + matched
    return score, counts


def symbol_table(counts: Sequence[dict[str, tuple[int, int, int]]]) -> str:
    """Return the precision and the recall of fixtures, summed over styles, as a Markdown table."""
    lines = ["| fixture | drawn | imported | precision | recall |", "|---|---|---|---|---|"]
    for kind in (*FIXTURES, "all"):
        chosen = FIXTURES if kind == "all" else (kind,)
        drawn, found, matched = np.sum([part[name] for part in counts for name in chosen], axis=0).tolist()
        precision = f"{100.0 * matched / found:.1f}%" if found else "-"
        lines.append(f"| {kind} | {drawn} | {found} | {precision} | {100.0 * matched / max(drawn, 1):.1f}% |")
    return "\n".join(lines)


@dataclass
class ScaleScore:
    """Relative errors of estimated scales, as logarithms, with their estimates; and the number of plans refused."""

    errors: list[float] = field(default_factory=list)
    stds: list[float] = field(default_factory=list)
    refused: int = 0


def measure_scale(style: Style, plans: int, first_seed: int = 0) -> ScaleScore:
    """Return the errors of the scales of plans without any text and without options."""
    score = ScaleScore()
    for seed in range(first_seed, first_seed + plans):
        drawn = draw_plan(style, seed, has_texts=False)
        try:
            report = import_plan(drawn.jpeg() if style == "scanned" else drawn.png()).report
        except InvalidFloorPlanError:
            score.refused += 1
            continue
        score.errors.append(abs(math.log(report.metres_per_unit / drawn.metres_per_pixel)))
        score.stds.append(report.scale_std)
    return score


def scale_table(scores: dict[str, ScaleScore]) -> str:
    """Return the errors of scales as a Markdown table, with a row of all styles."""
    everything = ScaleScore()
    for score in scores.values():
        everything.errors += score.errors
        everything.stds += score.stds
        everything.refused += score.refused
    lines = [
        "| style | plans | refused | error, median | 90th percentile | within two standard deviations |",
        "|---|---|---|---|---|---|",
    ]
    for style, score in {**scores, "all": everything}.items():
        errors = 100.0 * np.array(score.errors or [np.nan])
        within = np.mean(np.array(score.errors) <= 2.0 * np.array(score.stds)) if score.errors else np.nan
        lines.append(
            f"| {style} | {len(score.errors) + score.refused} | {score.refused} | {np.median(errors):.1f}% | "
            f"{np.percentile(errors, 90.0):.1f}% | {100.0 * within:.0f}% |"
        )
    return "\n".join(lines)


def table(scores: dict[str, Score], label: str = "style") -> str:
    """Return the figures as a Markdown table."""
    lines = [
        f"| {label} | rooms | found, IoU ≥ 0.9 | doors, F1 | windows, F1 | CPU time per picture |",
        "|---|---|---|---|---|---|",
    ]
    for style, score in scores.items():
        share = f"{100.0 * score.room_share:.1f}%"
        per_plan = score.seconds / max(score.plans, 1)
        lines.append(
            f"| {style} | {score.rooms} | {share} | {f1(score.door):.3f} | {f1(score.window):.3f} | {per_plan:.1f} s |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure every style and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=40, help="generated plans per style")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first plan")
    parser.add_argument(
        "--conditions", action="store_true", help="also measure plans with noise, shadow, furniture, JPEG"
    )
    parser.add_argument("--scale", action="store_true", help="measure the errors of estimated scales instead")
    parser.add_argument("--symbols", action="store_true", help="measure the symbols of fixtures that are found instead")
    arguments = parser.parse_args()
    if arguments.plans < 1:
        parser.error(f"--plans is {arguments.plans}, the minimum is 1")
    if arguments.symbols:
        measured = {style: measure_symbols(style, arguments.plans, arguments.seed) for style in STYLES}
        print(table({style: score for style, (score, _) in measured.items()}))
        print(symbol_table([counts for _, counts in measured.values()]))
        return
    if arguments.scale:
        print(scale_table({style: measure_scale(style, arguments.plans, arguments.seed) for style in STYLES}))
        return
    print(table({style: measure(style, arguments.plans, arguments.seed) for style in STYLES}))
    if arguments.conditions:
        # Four styles each.
        plans = max(1, arguments.plans // 4)
        scores = {name: measure_condition(name, plans, arguments.seed) for name in get_args(Condition)}
        print(table(scores, "condition"))


if __name__ == "__main__":
    main()
