"""Importing drawn floor plans: rooms, doors and windows found in pictures, by style of drawing.

`python -m benchmarks.plan_pictures` prints the table of docs/results.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass

import shapely

from benchmarks.plan_drawing import STYLES, DrawnPlan, OpeningSymbol, Style, draw_plan
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, import_plan

_IOU = 0.9
# An imported opening matches when it overlaps the true one by half of the longer, at most this far (m) beside it.
_OVERLAP, _APART_M = 0.5, 0.3


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


def score_plan(drawn: DrawnPlan, content: bytes, score: Score) -> None:
    """Import one picture and count the rooms and openings found; none where the import is refused."""
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


def table(scores: dict[str, Score]) -> str:
    """Return the figures as a Markdown table."""
    lines = [
        "| style | rooms | found, IoU ≥ 0.9 | doors, F1 | windows, F1 | CPU time per picture |",
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
    arguments = parser.parse_args()
    if arguments.plans < 1:
        parser.error(f"--plans is {arguments.plans}, the minimum is 1")
    print(table({style: measure(style, arguments.plans, arguments.seed) for style in STYLES}))


if __name__ == "__main__":
    main()
