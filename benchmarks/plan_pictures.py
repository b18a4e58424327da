"""How much of a drawn floor plan is understood: rooms, doors and windows found in pictures, by style of drawing.

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
# An opening is found where one of its kind overlaps it by half of the longer.
_OVERLAP, _APART_M = 0.5, 0.3


@dataclass
class Score:
    """Counts over plans of one style."""

    rooms: int = 0
    rooms_found: int = 0
    rooms_told: int = 0
    seconds: float = 0.0
    plans: int = 0
    door: tuple[int, int, int] = (0, 0, 0)
    window: tuple[int, int, int] = (0, 0, 0)

    @property
    def room_share(self) -> float:
        """Rooms found with an intersection over union of at least 0.9."""
        return self.rooms_found / max(self.rooms, 1)


def f1(counts: tuple[int, int, int]) -> float:
    """From (true, told, found)."""
    true, told, found = counts
    return 2.0 * found / max(true + told, 1)


def score_plan(drawn: DrawnPlan, content: bytes, score: Score) -> None:
    """Import one picture and count what was found; a refusal finds nothing."""
    began = time.process_time()
    try:
        document = import_plan(content, ImportOptions(metres_per_pixel=drawn.metres_per_pixel)).document
    except InvalidFloorPlanError:
        document = {"rooms": []}
    score.seconds += time.process_time() - began
    score.plans += 1
    told = [shapely.Polygon(room["polygon"], room.get("holes")) for room in document["rooms"]]
    score.rooms += len(drawn.rooms)
    score.rooms_told += len(told)
    score.rooms_found += sum(any(_iou(room, other) >= _IOU for other in told) for room in drawn.rooms)
    openings = document.get("openings", [])
    for kind in ("door", "window"):
        lines = [shapely.LineString(opening["line"]) for opening in openings if opening["kind"] == kind]
        truth = [opening for opening in drawn.openings if opening.kind == kind]
        counts = (len(truth), len(lines), _matches(truth, lines))
        setattr(score, kind, tuple(a + b for a, b in zip(getattr(score, kind), counts, strict=True)))


def _iou(a: shapely.Polygon, b: shapely.Polygon) -> float:
    shared = shapely.intersection(a, b).area
    return shared / (a.area + b.area - shared)


def _matches(truth: Sequence[OpeningSymbol], told: Sequence[shapely.LineString]) -> int:
    free = list(told)
    found = 0
    for opening in truth:
        line = shapely.LineString([opening.start, opening.end])
        around = line.buffer(_APART_M, cap_style="flat")
        for other in free:
            shared = shapely.intersection(around, other).length
            if shared >= _OVERLAP * max(line.length, other.length):
                free.remove(other)
                found += 1
                break
    return found


def measure(style: Style, plans: int, first_seed: int = 0) -> Score:
    """Import `plans` generated plans of a style."""
    score = Score()
    for seed in range(first_seed, first_seed + plans):
        drawn = draw_plan(style, seed)
        score_plan(drawn, drawn.jpeg() if style == "scanned" else drawn.png(), score)
    return score


def table(scores: dict[str, Score]) -> str:
    """The figures as Markdown."""
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
    parser.add_argument("--seed", type=int, default=0, help="the first plan's")
    arguments = parser.parse_args()
    if arguments.plans < 1:
        parser.error(f"--plans is {arguments.plans}, it must be at least 1")
    print(table({style: measure(style, arguments.plans, arguments.seed) for style in STYLES}))


if __name__ == "__main__":
    main()
