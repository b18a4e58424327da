"""Importing floor plans: rooms, doors and windows found in drawings of generated homes, of agents, and in faulty files.

`python -m benchmarks.plans` prints the figures of docs/results.md by style; `--conditions` those with noise,
shadow, furniture and as JPEG of 150 dpi; `--scale` the errors of scales that are estimated without any text;
`--symbols` the rooms and the precision and recall of fixtures, drawn as symbols among furniture.

`--data DIR` prints one table instead, to be compared before and after a change of the importers: `DIR/agentplans`,
generated homes, and `DIR/faults`, as far as they exist. Cells are "found/true (imported)". It is no group of
`lalaloc bench`, because `lalaloc_core` cannot import the drawings of this package.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from benchmarks.harness import argument_parser, print_table_head, table_row
from benchmarks.plan_drawing import STYLES, DrawnPlan, Style, draw_plan
from benchmarks.plan_symbols import FIXTURES
from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError
from lalaloc_core.importers import ImportOptions, import_plan, import_plans

Condition = Literal["clean", "noise, σ = 5", "shadow, 40 %", "noise and shadow", "furniture", "JPEG, 1:100 at 150 dpi"]
_SIGMA, _DARKEST, _PIXELS_PER_M_AT_150_DPI = 5.0, 0.6, 0.01 * 150.0 / 0.0254
_NO_SCANS = STYLES[:-1]
# An imported opening matches when it overlaps the true one by half of the longer, at most this far (m) beside it; in
# the table of `--data`, when their middles are near (m).
_OVERLAP, _APART_M, _NEAR_M, _SCALE_ERROR, _MAX_CELL = 0.5, 0.3, 0.4, 0.05, 160
_FAULTS_OF_PHOTOGRAPHS = ("film", "photo", "pin", "turn")


@dataclass(frozen=True)
class Count:
    """Number of drawn things, of imported ones, and of those in both."""

    drawn: int = 0
    imported: int = 0
    matched: int = 0

    def __add__(self, count: Count) -> Count:
        return Count(self.drawn + count.drawn, self.imported + count.imported, self.matched + count.matched)

    def __str__(self) -> str:
        return f"{self.matched}/{self.drawn} ({self.imported})"

    @property
    def f1(self) -> float:
        return 2.0 * self.matched / max(self.drawn + self.imported, 1)


@dataclass(frozen=True)
class Plan:
    """Plan as it is or as it is imported: rooms, lines of openings, and fixtures, by kind, in metres."""

    shapes: Sequence[tuple[str, BaseGeometry]] = ()
    storeys: int = 0
    metres_per_pixel: float = 0.0

    @classmethod
    def of(cls, documents: Sequence[Mapping[str, Any]], metres_per_pixel: float = 0.0, factor: float = 1.0) -> Plan:
        """Return the plan of storeys in the native format, with lengths multiplied by a factor."""
        shapes: list[tuple[str, BaseGeometry]] = []
        for storey in documents:
            shapes += [("room", shapely.Polygon(r["polygon"], r.get("holes")).buffer(0.0)) for r in storey["rooms"]]
            shapes += [(o["kind"], shapely.LineString(o["line"])) for o in storey.get("openings", [])]
            shapes += [(f["kind"], shapely.Polygon(f["outline"])) for f in storey.get("fixtures", [])]
        scaled = [(kind, shapely.transform(shape, lambda points: factor * points)) for kind, shape in shapes]
        return cls(scaled, len(documents), metres_per_pixel)

    @classmethod
    def drawn(cls, drawn: DrawnPlan) -> Plan:
        """Return the plan that a drawing shows."""
        shapes: list[tuple[str, BaseGeometry]] = [("room", room) for room in drawn.rooms]
        shapes += [(opening.kind, shapely.LineString([opening.start, opening.end])) for opening in drawn.openings]
        shapes += [(symbol.kind, symbol.outline) for symbol in drawn.symbols]
        return cls(shapes, 1, drawn.metres_per_pixel)

    def of_kind(self, kind: str) -> list[BaseGeometry]:
        return [shape for name, shape in self.shapes if name == kind]


@dataclass
class Score:
    """Counts of rooms, doors, windows and fixtures over plans, and the CPU time of their import."""

    counts: dict[str, Count] = field(default_factory=lambda: defaultdict(Count))
    seconds: float = 0.0
    plans: int = 0

    def add(self, drawn: DrawnPlan, content: bytes) -> None:
        """Import a picture, and count what is found; nothing where the import is refused."""
        began = time.process_time()
        try:
            document = import_plan(content, ImportOptions(metres_per_pixel=drawn.metres_per_pixel)).document
        except InvalidFloorPlanError:
            document = {"rooms": []}
        self.seconds += time.process_time() - began
        self.plans += 1
        for kind, count in count_found(Plan.drawn(drawn), Plan.of([document]), _EXACT).items():
            self.counts[kind] += count

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


def _near(truth: Sequence[BaseGeometry], imported: Sequence[BaseGeometry]) -> int:
    """Return the number of lines whose middles are near, one to one, the nearest first."""
    pairs = [(a.centroid.distance(b.centroid), i, j) for i, a in enumerate(truth) for j, b in enumerate(imported)]
    matched: dict[int, int] = {}
    for distance_m, i, j in sorted(pairs):
        if distance_m <= _NEAR_M and i not in matched and j not in matched.values():
            matched[i] = j
    return len(matched)


# Numbers of true shapes that are imported, by kind.
Measures = dict[str, Callable[[Sequence[BaseGeometry], Sequence[BaseGeometry]], int]]
_EXACT: Measures = {"room": partial(_overlapping, least=0.9), "door": _matches, "window": _matches}
_EXACT |= dict.fromkeys(FIXTURES, lambda true, imported: _overlapping(imported, true, 0.6))
TABLE: Measures = {"room": partial(_overlapping, least=0.8), "door": _near, "window": _near}


def count_found(truth: Plan, found: Plan, measures: Measures) -> dict[str, Count]:
    pairs = {kind: (truth.of_kind(kind), found.of_kind(kind)) for kind in measures}
    return {kind: Count(len(true), len(read), measures[kind](true, read)) for kind, (true, read) in pairs.items()}


def _file(style: Style, drawn: DrawnPlan) -> bytes:
    return drawn.jpeg() if style == "scanned" else drawn.png()


def measure(styles: Sequence[Style], seeds: range, condition: Condition = "clean", *, has_symbols: bool) -> Score:
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
        errors.append(None)
        with suppress(InvalidFloorPlanError):
            report = import_plan(_file(style, drawn)).report
            errors[-1] = (abs(math.log(report.metres_per_unit / drawn.metres_per_pixel)), report.scale_std)
    return errors


def _print_scales(errors: Mapping[str, list[tuple[float, float] | None]]) -> None:
    """Print the errors of scales, with a row of all styles."""
    print_table_head("style", "plans", "refused", "error, median", "90th percentile", "within two standard deviations")
    for style, found in {**errors, "all": [pair for pairs in errors.values() for pair in pairs]}.items():
        pairs = np.array([pair for pair in found if pair] or [(np.nan, np.nan)])
        median, most = 100.0 * np.percentile(pairs[:, 0], (50.0, 90.0))
        within = 100.0 * np.mean(pairs[:, 0] <= 2.0 * pairs[:, 1])
        print(table_row(style, len(found), found.count(None), f"{median:.1f}%", f"{most:.1f}%", f"{within:.0f}%"))


def read_plan(name: str, content: bytes, truth: Plan, scale: str) -> dict[str, Any]:
    """Return a plan's row by its "given" or "own" scale; the note is the scale's error, areas (m²), or a failure."""
    found, true_scale = Plan(), truth.metres_per_pixel
    try:
        found = _import(content, truth, true_scale if scale == "given" else None)
        areas = ", ".join(f"{room.area:.1f}" for room in found.of_kind("room"))
        note = f"{found.metres_per_pixel / true_scale - 1.0:+.1%}" if true_scale else f"{areas} m²"
    except InvalidInputError as error:
        note = f"refused: {error}"
    except Exception as error:
        note = f"{type(error).__name__}: {error}"
    is_read, has_scale = int(found.storeys > 0), int(true_scale > 0.0)
    is_right = int(abs(found.metres_per_pixel - true_scale) <= _SCALE_ERROR * true_scale) * has_scale
    counts = {"read": Count(1, is_read, is_read), "right scale": Count(has_scale, is_read * has_scale, is_right)}
    counts["storey"] = Count(truth.storeys, found.storeys, min(truth.storeys, found.storeys))
    return {"plan": name, "scale": scale, **counts, **count_found(truth, found, TABLE), "note": note}


def _import(content: bytes, truth: Plan, metres_per_pixel: float | None) -> Plan:
    """Import a plan, with all storeys that are drawn beside each other, and return it at its true scale.

    The clock stands still, so that no limit of time makes the result depend on the machine.
    """
    plans = import_plans(content, ImportOptions(metres_per_pixel=metres_per_pixel), clock=lambda: 0.0)
    scale = plans[0].report.metres_per_unit
    return Plan.of([plan.document for plan in plans], scale, (truth.metres_per_pixel or scale) / scale)


def _rows(name: str, cases: Iterable[tuple[str, bytes, Plan]], *, is_listed: bool = True) -> Iterator[dict[str, Any]]:
    """Yield the row of every case, if they are listed, and their sums by scale, with the notes of failures."""
    by_scale: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for case in cases:
        for scale in ("given", "own") if case[2].metres_per_pixel else ("own",):
            by_scale[scale].append(read_plan(*case, scale))
            yield from by_scale[scale][-1:] if is_listed else ()
    for scale, rows in by_scale.items():
        failures = Counter(row["note"] for row in rows if not row["read"].matched).most_common()
        sums = {key: sum((row[key] for row in rows), Count()) for key in rows[0] if isinstance(rows[0][key], Count)}
        yield {"plan": name, "scale": scale, **sums, "note": "; ".join(f"{times} × {note}" for note, times in failures)}


def _all_rows(data: Path, seeds: range) -> Iterator[dict[str, Any]]:
    yield from _rows("all of agents", map(_agent_case, sorted(data.glob("agentplans/*/truth.json"))))
    for name, styles in (("clean", _NO_SCANS), ("crowded", _NO_SCANS), ("scanned", STYLES[-1:])):
        drawings = (draw_plan(styles[seed % len(styles)], seed, has_symbols=name == "crowded") for seed in seeds)
        cases = ((name, drawn.jpeg() if name == "scanned" else drawn.png(), Plan.drawn(drawn)) for drawn in drawings)
        yield from _rows(name, cases, is_listed=False)
    files = (path for path in sorted(data.glob("faults/kinds/*/*.*")) if path.suffix != ".md")
    plans = (path for path in files if not path.parent.name.startswith(_FAULTS_OF_PHOTOGRAPHS))
    yield from _rows("all faults", ((f"{path.parent.name}/{path.name}", path.read_bytes(), Plan()) for path in plans))


def _agent_case(truth: Path) -> tuple[str, bytes, Plan]:
    document, scale = json.loads(truth.read_bytes()), json.loads(truth.with_name("scale.json").read_bytes())
    plan = Plan.of(document.get("plans", [document]), scale["metres_per_pixel"])
    return truth.parent.name, next(truth.parent.glob("plan.*")).read_bytes(), plan


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--plans", type=int, default=40, help="plans per style; half as many per row of --data")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first plan")
    parser.add_argument("--conditions", action="store_true", help="also measure noise, shadow, furniture and JPEG")
    parser.add_argument("--scale", action="store_true", help="measure the errors of estimated scales instead")
    parser.add_argument("--symbols", action="store_true", help="measure the symbols of fixtures that are found instead")
    parser.add_argument("--data", type=Path, help="print the table of all plans instead, with those of this folder")
    parser.add_argument("--json", type=Path, help="write the rows of that table to this file")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.plans)
    if options.data:
        print_table_head("plan", "scale", "read", "right scale", "storey", *TABLE, "note")
        rows = []
        for row in _all_rows(options.data, seeds[: max(1, options.plans // 2)]):
            cells = (" ".join(str(value).split())[:_MAX_CELL].replace("|", "/") for value in row.values())
            print(table_row(*cells), flush=True)
            rows.append(row)
        if options.json:
            options.json.write_text(json.dumps(rows, default=vars, indent=1) + "\n", encoding="utf-8")
        return
    if options.scale:
        _print_scales({style: scale_errors(style, seeds) for style in STYLES})
        return
    scores = _print_scores((style, measure((style,), seeds, has_symbols=options.symbols)) for style in STYLES)
    if options.symbols:
        _print_symbols(scores)
    if options.conditions:
        few = seeds[: max(1, options.plans // 4)]
        scores = ((name, measure(_NO_SCANS, few, name, has_symbols=False)) for name in get_args(Condition))
        _print_scores(scores, "condition")


if __name__ == "__main__":
    main()
