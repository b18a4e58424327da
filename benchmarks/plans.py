"""Importing drawn floor plans: rooms, doors and windows found in pictures, by style and by condition.

`python -m benchmarks.plans` prints the figures of docs/results.md by style; `--conditions` those with noise,
shadow, furniture and as JPEG of 150 dpi; `--scale` the errors of scales that are estimated without any text;
`--symbols` the rooms and the precision and recall of fixtures, drawn as symbols among furniture.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from benchmarks.harness import argument_parser, print_table_head, table_row
from benchmarks.plan_drawing import STYLES, DrawnPlan, Style, draw_plan
from benchmarks.plan_symbols import FIXTURES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportOptions, import_plan

_IOU, _SYMBOL_IOU = 0.9, 0.6
# An imported opening matches when it overlaps the true one by half of the longer, at most this far (m) beside it.
_OVERLAP, _APART_M = 0.5, 0.3
# Number of lines that match others.
Matches = Callable[[Sequence[BaseGeometry], Sequence[BaseGeometry]], int]
Condition = Literal["clean", "noise, σ = 5", "shadow, 40 %", "noise and shadow", "furniture", "JPEG, 1:100 at 150 dpi"]
_SIGMA, _DARKEST, _PIXELS_PER_M_AT_150_DPI = 5.0, 0.6, 0.01 * 150.0 / 0.0254


@dataclass(frozen=True)
class Count:
    """Number of drawn things, of imported ones, and of those in both."""

    drawn: int = 0
    imported: int = 0
    matched: int = 0

    def __add__(self, count: Count) -> Count:
        return Count(self.drawn + count.drawn, self.imported + count.imported, self.matched + count.matched)

    @property
    def f1(self) -> float:
        """F1 score."""
        return 2.0 * self.matched / max(self.drawn + self.imported, 1)


@dataclass(frozen=True)
class Shapes:
    """Rooms of plans, and lines of openings with their kinds, in metres."""

    rooms: Sequence[BaseGeometry] = ()
    openings: Sequence[tuple[str, BaseGeometry]] = ()

    @classmethod
    def of(cls, plans: Sequence[Mapping[str, Any]], factor: float = 1.0) -> Shapes:
        """Return the shapes of documents in the native format, with all lengths multiplied by a factor."""

        def scaled(shape: BaseGeometry) -> BaseGeometry:
            return shapely.transform(shape, lambda points: factor * points)

        rooms = [shapely.Polygon(room["polygon"], room.get("holes")) for plan in plans for room in plan["rooms"]]
        openings = [(o["kind"], shapely.LineString(o["line"])) for plan in plans for o in plan.get("openings", [])]
        return cls([scaled(room.buffer(0.0)) for room in rooms], [(kind, scaled(line)) for kind, line in openings])

    @classmethod
    def drawn(cls, drawn: DrawnPlan) -> Shapes:
        """Return the rooms and openings that a drawing shows."""
        return cls(drawn.rooms, [(o.kind, shapely.LineString([o.start, o.end])) for o in drawn.openings])

    def lines(self, kind: str) -> list[BaseGeometry]:
        """Return the openings of a kind."""
        return [line for name, line in self.openings if name == kind]


@dataclass
class Score:
    """Counts of rooms, doors, windows and fixtures over plans, and the CPU time of their import."""

    counts: dict[str, Count] = field(default_factory=lambda: defaultdict(Count))
    seconds: float = 0.0
    plans: int = 0

    def add(self, drawn: DrawnPlan, content: bytes) -> dict[str, Any]:
        """Import a picture, count what is found, and return the plan; none where the import is refused."""
        began = time.process_time()
        try:
            document = import_plan(content, ImportOptions(metres_per_pixel=drawn.metres_per_pixel)).document
        except InvalidFloorPlanError:
            document = {"rooms": []}
        self.seconds += time.process_time() - began
        self.plans += 1
        found = count_found(Shapes.drawn(drawn), Shapes.of([document]), _IOU, _matches)
        for kind, count in found.items():
            self.counts[kind] += count
        for kind in FIXTURES:
            outlines = [shapely.Polygon(e["outline"]) for e in document.get("fixtures", []) if e["kind"] == kind]
            symbols = [symbol.outline for symbol in drawn.symbols if symbol.kind == kind]
            matched = _overlapping(outlines, symbols, _SYMBOL_IOU)
            self.counts[kind] += Count(len(symbols), len(outlines), matched)
        return document

    def row(self, label: str) -> str:
        """Return the figures of rooms and openings as a row of a Markdown table."""
        room, per_plan = self.counts["room"], self.seconds / max(self.plans, 1)
        share = f"{100.0 * room.matched / max(room.drawn, 1):.1f}%"
        scores = (f"{self.counts[kind].f1:.3f}" for kind in ("door", "window"))
        return table_row(label, room.drawn, share, *scores, f"{per_plan:.1f} s")


def intersection_over_union(a: BaseGeometry, b: BaseGeometry) -> float:
    """Return the share of the area of two shapes that both cover."""
    shared = shapely.intersection(a, b).area
    return shared / (a.area + b.area - shared)


def _overlapping(shapes: Sequence[BaseGeometry], others: Sequence[BaseGeometry], least: float) -> int:
    return sum(any(intersection_over_union(shape, other) >= least for other in others) for shape in shapes)


def _matches(truth: Sequence[BaseGeometry], imported: Sequence[BaseGeometry]) -> int:
    unmatched = list(imported)
    for line in truth:
        around = line.buffer(_APART_M, cap_style="flat")
        for candidate in unmatched:
            shared = shapely.intersection(around, candidate).length
            if shared >= _OVERLAP * max(line.length, candidate.length):
                unmatched.remove(candidate)
                break
    return len(imported) - len(unmatched)


def count_found(truth: Shapes, found: Shapes, least_iou: float, matches: Matches) -> dict[str, Count]:
    """Return the counts of rooms, and of doors and windows of the right kind."""
    rooms = _overlapping(truth.rooms, found.rooms, least_iou)
    counts = {"room": Count(len(truth.rooms), len(found.rooms), rooms)}
    for kind in ("door", "window"):
        true, lines = truth.lines(kind), found.lines(kind)
        counts[kind] = Count(len(true), len(lines), matches(true, lines))
    return counts


def _file(style: Style, drawn: DrawnPlan) -> bytes:
    return drawn.jpeg() if style == "scanned" else drawn.png()


def measure(
    styles: Sequence[Style], seeds: range, condition: Condition = "clean", *, has_symbols: bool = False
) -> Score:
    """Return the score of generated plans of some styles under a condition."""
    score, pixels_per_m = Score(), _PIXELS_PER_M_AT_150_DPI if condition.startswith("JPEG") else None
    for style, seed in itertools.product(styles, seeds):
        is_furnished = condition == "furniture"
        drawn = draw_plan(style, seed, is_furnished=is_furnished, has_symbols=has_symbols, pixels_per_m=pixels_per_m)
        if "shadow" in condition:
            drawn = drawn.shaded(_DARKEST)
        if "noise" in condition:
            drawn = drawn.noisy(_SIGMA, seed)
        score.add(drawn, drawn.jpeg() if pixels_per_m else _file(style, drawn))
    return score


def _print_scores(scores: Iterator[tuple[str, Score]], label: str = "style") -> list[Score]:
    """Print the rows as they are measured."""
    print_table_head(label, "rooms", "found, IoU ≥ 0.9", "doors, F1", "windows, F1", "CPU time per picture")
    measured = []
    for name, score in scores:
        print(score.row(name), flush=True)
        measured.append(score)
    return measured


def _print_symbols(scores: Sequence[Score]) -> None:
    """Print the precision and the recall of fixtures, summed over styles."""
    print_table_head("fixture", "drawn", "imported", "precision", "recall")
    for name in (*FIXTURES, "all"):
        kinds = FIXTURES if name == "all" else (name,)
        total = sum((score.counts[kind] for score in scores for kind in kinds), Count())
        precision = f"{100.0 * total.matched / total.imported:.1f}%" if total.imported else "-"
        recall = f"{100.0 * total.matched / max(total.drawn, 1):.1f}%"
        print(table_row(name, total.drawn, total.imported, precision, recall))


def scale_errors(style: Style, seeds: range) -> list[tuple[float, float] | None]:
    """Return the errors of scales, as logarithms, with their standard deviations, of plans without text and options."""
    errors: list[tuple[float, float] | None] = []
    for seed in seeds:
        drawn = draw_plan(style, seed, has_texts=False)
        try:
            report = import_plan(_file(style, drawn)).report
        except InvalidFloorPlanError:
            errors.append(None)
        else:
            errors.append((abs(math.log(report.metres_per_unit / drawn.metres_per_pixel)), report.scale_std))
    return errors


def _print_scales(errors: Mapping[str, list[tuple[float, float] | None]]) -> None:
    """Print the errors of scales, with a row of all styles."""
    print_table_head("style", "plans", "refused", "error, median", "90th percentile", "within two standard deviations")
    for style, found in {**errors, "all": [pair for pairs in errors.values() for pair in pairs]}.items():
        pairs = np.array([pair for pair in found if pair] or [(np.nan, np.nan)])
        median, most = 100.0 * np.percentile(pairs[:, 0], (50.0, 90.0))
        within = 100.0 * np.mean(pairs[:, 0] <= 2.0 * pairs[:, 1])
        print(table_row(style, len(found), found.count(None), f"{median:.1f}%", f"{most:.1f}%", f"{within:.0f}%"))


def main() -> None:
    """Measure and print the tables."""
    parser = argument_parser(__doc__)
    parser.add_argument("--plans", type=int, default=40, help="generated plans per style")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first plan")
    parser.add_argument("--conditions", action="store_true", help="also measure noise, shadow, furniture and JPEG")
    parser.add_argument("--scale", action="store_true", help="measure the errors of estimated scales instead")
    parser.add_argument("--symbols", action="store_true", help="measure the symbols of fixtures that are found instead")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.plans)
    if options.scale:
        _print_scales({style: scale_errors(style, seeds) for style in STYLES})
        return
    scores = _print_scores((style, measure((style,), seeds, has_symbols=options.symbols)) for style in STYLES)
    if options.symbols:
        _print_symbols(scores)
    if options.conditions:
        few = range(options.seed, options.seed + max(1, options.plans // 4))
        _print_scores(((name, measure(STYLES[:-1], few, name)) for name in get_args(Condition)), "condition")


if __name__ == "__main__":
    main()
