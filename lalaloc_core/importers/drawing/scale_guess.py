"""Scale of drawings without one, estimated from the usual sizes of their parts.

Every kind of part is a clue: a likelihood over the logarithm of the scale. Their product gives the scale and its error.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import extent_of
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder, ScaleClue
from lalaloc_core.importers.common.sketch import Sketch
from lalaloc_core.importers.drawing.drawing_scale import Dimension, Scale, areas_of_rooms, values_m
from lalaloc_core.importers.drawing.vector_drawing import Drawing, Lettering

# Logarithms of scales that are compared, around the first one.
_REACH, _STEP = 1.2, 0.002
# Door leaves (m): standard widths lie between these, most near the middle; with the part of other arcs.
_LEAF_M, _LEAF_EDGE, _USUAL_LEAF_M, _LEAF_STD, _OTHER_ARCS = (0.61, 1.01), 0.03, 0.84, 0.1, 0.08
# Doors of one home are alike, as they are of one country and time.
_ALIKE_STD = 0.025
# Usual size (m) of walls, treads and buildings, with standard deviation as a share.
_WALL, _TREAD, _EXTENT = (0.16, 0.3), (0.28, 0.06), (12.0, 0.6)
# Longer sides of fixtures that have a standard size.
_FIXTURE: Mapping[str, tuple[float, float]] = {
    "bed": (2.0, 0.05), "bath": (1.7, 0.06), "stove": (0.6, 0.08), "washer": (0.6, 0.06), "fridge": (0.63, 0.1),
    "toilet": (0.66, 0.12), "shower": (0.9, 0.12),
}  # fmt: skip
# Standard deviations of written areas (of a length) and dimensions, and the shares of clues of a kind that mislead.
_AREA_STD, _DIMENSION_STD = 0.025, 0.01
_WRONG: Mapping[str, float] = {"wall": 0.1, "tread": 0.4, "fixture": 0.2, "area": 0.3, "dimension": 0.5}
# Probability that all parts of a kind mislead alike.
_MISLEADS: Mapping[str, float] = {
    "leaf": 0.1, "wall": 0.1, "tread": 0.2, "fixture": 0.1, "area": 0.01, "dimension": 0.02,
}  # fmt: skip
_QUANTILES = (0.1587, 0.5, 0.8413)
# A scale with a larger error is not used; so many parts of a kind must agree on it, within so many standard deviations.
_MAX_STD, _MIN_PARTS, _AGREE_STDS, _AGREE, _CONTRADICTS = 0.1, 2, 3.0, 0.03, 0.14
_MAX_PASSES, _CONVERGED, _SHARE_OF_TIME = 4, 0.04, 0.4
# Difference of the logarithms of a guess and a scale that is written beside others.
_NEAR_WRITTEN = 0.35
# First scales that are tried, relative to the likeliest.
_FIRST_SHARES = (1.0, 1.6, 1.0 / 1.6, 2.56)
_NAMES: Mapping[str, tuple[str, str]] = {
    "leaf": ("door leaf", "door leaves"), "wall": ("thickness of walls", "thickness of walls"),
    "tread": ("stair", "stairs"), "fixture": ("fixture", "fixtures"), "area": ("written area", "written areas"),
    "dimension": ("written dimension", "written dimensions"),
}  # fmt: skip

Likelihood = Float[np.ndarray, "n"]
_MIN_LINES, _MAX_LINES = 6, 5000
# Largest deviation of distances, and of ends as a share of a line's length.
_EVEN, _FLUSH = 0.1, 0.05
# Width of a stair in treads; wider patterns are hatches.
_WIDE = (2.3, 8.0)


@dataclass(frozen=True)
class Measures:
    """Sizes of the parts of a drawing, in its units; `areas` are pairs of m² and square units."""

    leaves: Sequence[float] = ()
    wall: float = 0.0
    treads: Sequence[float] = ()
    fixtures: Sequence[tuple[str, float]] = ()
    areas: Sequence[tuple[float, float]] = ()
    dimensions: Sequence[Dimension] = ()
    extent: float = 0.0

    @classmethod
    def of(
        cls, sketch: Sketch, scale: float, texts: Sequence[Lettering], drawing: Drawing, dimensions: Sequence[Dimension]
    ) -> Measures:
        """Return the sizes of the parts in a sketch at a scale, in units of the drawing.

        `texts` are placed in the metres of the sketch, `drawing` has the lines in its own units.
        """
        areas = areas_of_rooms([room.shape for room in sketch.rooms], texts)
        fixtures = [(item.kind, extent_of([item.shape]) / scale) for item in sketch.fixtures if item.kind in _FIXTURE]
        return cls(
            [leaf_m / scale for leaf_m in sketch.leaves_m],
            sketch.wall_m / scale,
            tread_spacings(stroke.line for stroke in drawing.strokes),
            fixtures,
            [(written_m2, area_m2 / scale**2) for written_m2, area_m2 in areas.values()],
            dimensions,
            extent_of([room.shape for room in sketch.rooms]) / scale if sketch.rooms else 0.0,
        )


@dataclass(frozen=True)
class ScaleGuess:
    """Estimated scale: metres per unit, its standard deviation as a share of it, and its clues."""

    metres_per_unit: float
    std: float
    clues: tuple[ScaleClue, ...] = field(default=())

    @property
    def source(self) -> str:
        """Source of the scale, in words."""
        parts = [_in_words(clue) for clue in self.clues if clue.is_used]
        return f"estimated from {', '.join(parts)} (±{100.0 * self.std:.1f} %)"

    @property
    def assumption(self) -> str:
        """Warning about the assumed scale."""
        unused = [_in_words(clue) for clue in self.clues if not clue.is_used]
        against = f"; not used, as they disagree: {', '.join(unused)}" if unused else ""
        return (
            f"the file gives no scale; {self.metres_per_unit:.4g} m per unit is assumed, {self.source}{against}; set "
            "known_distance, metres_per_pixel or scale for an exact one"
        )


def assume_scale(guess: ScaleGuess | None, builder: ReportBuilder, written: Sequence[Scale] = ()) -> Scale | None:
    """Return the only scale written that is near a guessed one, else that as an assumption; None without a guess."""
    if guess is None:
        return None
    near = [scale for scale in written if abs(math.log(scale[0] / guess.metres_per_unit)) <= _NEAR_WRITTEN]
    if len(near) == 1:
        others = ", ".join(source.partition(",")[0] for _, source in written)
        builder.notes.append(f"of the scales written, {others}, {near[0][1]}, is nearest to that {guess.source}")
        return near[0]
    builder.scale_std, builder.scale_clues = guess.std, guess.clues
    builder.warnings.append(guess.assumption)
    return guess.metres_per_unit, guess.source


def guess_scale(sketch: Callable[[float], Measures], start: float, budget: Budget) -> ScaleGuess | None:
    """Return the scale that the sizes of parts agree on, None if they are too few or too different.

    `sketch` reads the drawing at a scale, in metres per unit, and returns the sizes of its parts; the first scale is
    `start`, and others follow until one leads to a certain scale. The guess takes at most a part of the import's time.
    """
    budget.begin("estimating the scale")
    # The readings on the way are no steps of their own.
    (trace, budget.trace), (on_step, budget.on_step) = (budget.trace, None), (budget.on_step, None)
    end_s = budget.elapsed_s + _SHARE_OF_TIME * budget.limits.max_import_s
    guesses = (_settle(sketch, share * start, end_s, budget) for share in _FIRST_SHARES)
    try:
        return next((guess for guess in guesses if guess is not None or budget.elapsed_s > end_s), None)
    finally:
        budget.trace, budget.on_step = trace, on_step


def _settle(sketch: Callable[[float], Measures], scale: float, end_s: float, budget: Budget) -> ScaleGuess | None:
    """Return the scale at which parts have the sizes they were read with, None if it is uncertain."""
    guess = None
    for _ in range(_MAX_PASSES):
        budget.check_time()
        try:
            guess = combine(sketch(scale), scale)
        except InvalidFloorPlanError:
            budget.check_time()
            guess = None
        if guess is None or abs(math.log(guess.metres_per_unit / scale)) <= _CONVERGED or budget.elapsed_s > end_s:
            break
        scale = guess.metres_per_unit
    if guess is None:
        return None
    # Walls alone have many thicknesses.
    parts = sum(clue.count for clue in guess.clues if clue.is_used and clue.kind != "wall")
    return guess if guess.std <= _MAX_STD and parts >= _MIN_PARTS else None


def combine(measures: Measures, around: float) -> ScaleGuess | None:
    """Return the scale by all clues near a scale, None without clues."""
    grid = math.log(around) + np.arange(-_REACH, _REACH + _STEP, _STEP)
    prior = np.zeros(len(grid))
    if measures.extent > 0.0:
        prior = _or_wrong(_normal(grid, math.log(_EXTENT[0] / measures.extent), _EXTENT[1]), 0.05)
    kinds = {kind: found for kind, found in _likelihoods(measures, grid).items() if found[0]}
    if not kinds:
        return None
    bounded = [_bounded(likelihood, _MISLEADS[kind]) for kind, (_, likelihood) in kinds.items()]
    middle, std = _middle(sum(bounded, start=prior), grid)
    clues, agreeing = [], _agreeing(measures, math.exp(middle))
    for kind, (count, likelihood) in kinds.items():
        own, own_std = _middle(likelihood + prior, grid)
        limit = min(max(_AGREE_STDS * math.hypot(own_std, std), _AGREE), max(1.8 * own_std, _CONTRADICTS))
        agrees = abs(own - middle) <= limit
        clues.append(ScaleClue(kind, agreeing.get(kind, count), math.exp(own), own_std, agrees))
    return ScaleGuess(math.exp(middle), std, tuple(clues))


def first_scale(extent: float, leaves: Sequence[float] = ()) -> float:
    """Return a scale to begin with, by the median of arcs that can be leaves of doors, else by the extent."""
    return _USUAL_LEAF_M / float(np.median(leaves)) if len(leaves) else 1.2 * _EXTENT[0] / extent


def _agreeing(measures: Measures, scale: float) -> dict[str, int]:
    """Return the number of written areas and dimensions that are true at a scale."""
    lengths = [scale * math.sqrt(units2 / m2) for m2, units2 in measures.areas]
    ratios = [
        [abs(math.log(scale * length / m)) for m in values_m(text) for length in lengths if length > 0.0]
        for text, lengths in measures.dimensions
    ]
    return {
        "area": sum(abs(math.log(length)) <= _AGREE_STDS * _AREA_STD for length in lengths),
        "dimension": sum(min(own, default=math.inf) <= _AGREE_STDS * _DIMENSION_STD for own in ratios),
    }


def _likelihoods(measures: Measures, grid: Likelihood) -> dict[str, tuple[int, Likelihood]]:
    """Return the number of parts of each kind, and their likelihood over the grid."""
    none = np.zeros(len(grid))

    def usual(kind: str, sizes: Sequence[tuple[float, tuple[float, float]]]) -> tuple[int, Likelihood]:
        densities = [_normal(grid, math.log(m / size), std) for size, (m, std) in sizes if size > 0.0]
        return len(densities), sum((_or_wrong(density, _WRONG[kind]) for density in densities), start=none)

    dimensions = [_dimension(grid, dimension) for dimension in measures.dimensions]
    # Stairs of one home are alike, so all of them tell what one does.
    tread = [(float(np.median(measures.treads)), _TREAD)] if measures.treads else []
    return {
        "leaf": (len(measures.leaves), _leaves(grid, measures.leaves)),
        "wall": usual("wall", [(measures.wall, _WALL)]),
        "tread": (len(measures.treads), usual("tread", tread)[1]),
        "fixture": usual("fixture", [(size, _FIXTURE[kind]) for kind, size in measures.fixtures]),
        "area": usual("area", [(math.sqrt(units2), (math.sqrt(m2), _AREA_STD)) for m2, units2 in measures.areas]),
        "dimension": (len(dimensions), sum(dimensions, start=none)),
    }


def _leaves(grid: Likelihood, leaves: Sequence[float]) -> Likelihood:
    """Return the likelihood of leaves' widths, blurred as doors of a home are alike."""
    total, (low, high) = np.zeros(len(grid)), np.log(_LEAF_M)
    for leaf in leaves:
        size = grid + math.log(leaf)
        above, below = (1.0 + np.tanh(0.5 * (edge / _LEAF_EDGE)) for edge in (size - low, high - size))
        inside = 0.25 * above * below / (high - low)
        total += _or_wrong(0.5 * (inside + _normal(size, math.log(_USUAL_LEAF_M), _LEAF_STD)), _OTHER_ARCS)
    kernel = _normal(np.arange(-4.0 * _ALIKE_STD, 4.0 * _ALIKE_STD + _STEP, _STEP), 0.0, _ALIKE_STD)
    blurred = np.convolve(np.exp(total - total.max()), kernel / kernel.sum(), mode="same")
    return np.log(np.maximum(blurred, 1e-300)) + float(total.max())


def _normal(grid: Likelihood, middle: float, std: float) -> Likelihood:
    """Return a normal density."""
    return np.exp(-0.5 * ((grid - middle) / std) ** 2) / (std * math.sqrt(2.0 * math.pi))


def _or_wrong(density: Likelihood, wrong: float) -> Likelihood:
    """Return the logarithm of a density, and of a flat one for the share of parts that are `wrong`."""
    return np.log((1.0 - wrong) * density + wrong / (2.0 * _REACH))


def _dimension(grid: Likelihood, dimension: Dimension) -> Likelihood:
    """Return the likelihood of a written length: one of the lines beside it is meant, or none."""
    text, lengths = dimension
    ratios = [value_m / length for value_m in values_m(text) for length in lengths if length > 0.0]
    terms = [_normal(grid, math.log(ratio), _DIMENSION_STD) for ratio in ratios]
    return _or_wrong(sum(terms, start=np.zeros(len(grid))) / max(len(terms), 1), _WRONG["dimension"])


def _bounded(log_density: Likelihood, wrong: float) -> Likelihood:
    """Return the likelihood of a kind that misleads as a whole with a probability, such as a hatch read as stairs."""
    density = np.exp(log_density - log_density.max())
    return np.log((1.0 - wrong) * density / density.sum() + wrong / len(density))


def _middle(log_density: Likelihood, grid: Likelihood) -> tuple[float, float]:
    """Return the median, and half of the interval that holds what a standard deviation around it does."""
    total = np.cumsum(np.exp(log_density - log_density.max()))
    low, middle, high = np.interp(_QUANTILES, total / total[-1], grid)
    return float(middle), float(0.5 * (high - low))


def _in_words(clue: ScaleClue) -> str:
    one, several = _NAMES[clue.kind]
    return f"the {one}" if clue.kind == "wall" else f"{clue.count} {one if clue.count == 1 else several}"


def tread_spacings(lines: Iterable[shapely.LineString]) -> list[float]:
    """Return the distance of the lines of every flight of stairs along an axis, in units of the drawing."""
    across: dict[tuple[bool, int, int], list[tuple[float, float]]] = defaultdict(list)
    for line in list(lines)[:_MAX_LINES]:
        x0, y0, x1, y1 = line.bounds
        width, height = x1 - x0, y1 - y0
        length = max(width, height)
        if length <= 0.0 or min(width, height) > 0.02 * length:
            continue
        is_vertical = height > width
        first, last, level = (y0, y1, x0) if is_vertical else (x0, x1, y0)
        # Lines of one flight begin and end at the same places.
        size = round(np.log(length) / (2.0 * _FLUSH))
        unit = 2.0 * _FLUSH * np.exp(2.0 * _FLUSH * size)
        across[is_vertical, size, round((first + last) / unit)].append((level, length))
    return [spacing for group in across.values() if len(group) >= _MIN_LINES for spacing in _flights(sorted(group))]


def _flights(lines: list[tuple[float, float]]) -> list[float]:
    """Return the spacing of each run of equally spaced lines, given as (level, length)."""
    levels, lengths = np.array(lines).T
    length = float(np.median(lengths))
    steps = np.diff(levels)
    runs: list[list[float]] = []
    for step in steps[steps > 1e-6 * length].tolist():
        if runs and abs(step / runs[-1][0] - 1.0) <= _EVEN:
            runs[-1].append(step)
        else:
            runs.append([step])
    spacings = [sum(run) / len(run) for run in runs if len(run) >= _MIN_LINES - 1]
    return [spacing for spacing in spacings if _WIDE[0] <= length / spacing <= _WIDE[1]]
