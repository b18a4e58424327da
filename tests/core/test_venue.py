"""Tests of venues: plan prototypes, the index that selects plans, merged plans, and the probability of a plan."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PoseGrid, layouts_at
from lalaloc_core.localise.match.coarse_pass import CoarseTable, coarse_costs
from lalaloc_core.localise.match.pose_grid import SPHERE_AZIMUTHS, VIEW_AZIMUTHS, BinnedLayouts
from lalaloc_core.localise.query import CameraHeight, Query, rolled
from lalaloc_core.localise.query.query import PredictedCeiling, PredictedOpenings, PredictedProfile, PredictedRoomType
from lalaloc_core.localise.venue.index_search import DividedIndex, PlanSearch, SearchLimits
from lalaloc_core.localise.venue.index_segment import CodeScan, lookup_tables, product_codes
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import FAMILIES, Cells, claims_of, family_of, shipped_cells
from lalaloc_core.localise.venue.prototype_costs import PrototypeAlignment, PrototypeCosts
from lalaloc_core.localise.venue.prototypes import (
    AZIMUTHS,
    claims_of_trust,
    most_probable,
    packed_openings,
    prototypes_of,
    share_searched,
    trust_of_claims,
    unpacked_openings,
)
from lalaloc_core.render.sampling import PoseSet, pose_grid
from lalaloc_core.render.sweep import profiles_at
from tests.strategies import plan_document, present, rectangle

COLUMNS, STEP_M = 64, 0.5
WEIGHTS, CONFIG = MatchingWeights(temperature=40.0, openings=0.4, ceiling=0.1, room_type=0.05), MatchingConfig()
CLASSES = len(OPENING_CLASSES)


def two_rooms(
    width_m: float,
    depth_m: float,
    second_m: float = 2.9,
    *,
    x_m: float = 0.0,
    ceiling_m: float = 2.5,
    kinds: tuple[str, ...] | None = None,
) -> FloorPlan:
    """Return two rooms side by side from `x_m`, with those of a door between them and a window that are of `kinds`."""
    (first, second), door_m = (x_m, x_m + width_m + 0.1), x_m + width_m + 0.05
    rooms = [rectangle(width_m, depth_m, corner=(first, 0.0)), rectangle(second_m, 3.0, corner=(second, 0.0))]
    document = plan_document(*rooms, ceiling_m=ceiling_m)
    document["rooms"][0]["type"] = "kitchen"
    document["openings"] = [
        {"kind": "door", "line": [[door_m, 1.0], [door_m, 1.9]]},
        {"kind": "window", "line": [[x_m + 0.5, 0], [x_m + 1.7, 0]], "sill_m": 0.9, "head_m": 2.0},
    ]
    if kinds is not None:
        document["opening_kinds"] = list(kinds)
        document["openings"] = [opening for opening in document["openings"] if opening["kind"] in kinds]
    return FloorPlan.from_dict(document)


def random_plan(rng: np.random.Generator, *, kinds: tuple[str, ...] | None = None) -> FloorPlan:
    sizes_m = rng.uniform(2.5, 7.0, 3).tolist()
    return two_rooms(*sizes_m, ceiling_m=float(rng.uniform(2.3, 3.0)), kinds=kinds)


def grid_of(plan: FloorPlan) -> PoseGrid:
    poses = pose_grid(plan, STEP_M)
    profile_m = profiles_at(plan, poses.position_m, poses.room_index, np.zeros(len(poses)), COLUMNS, np.float32)
    return PoseGrid(poses, np.zeros((len(poses), 1), np.float32), profile_m, STEP_M, 1.5)


def query_of(log_m: np.ndarray, scale: float, kind: np.ndarray, hypotheses: int, **more: Any) -> Query:
    """Return a prediction of walls and opening classes by column, whose first heading hypothesis is the frame's."""
    log_probability = np.log(np.where(kind[:, None] == np.arange(CLASSES), 0.85, 0.05))
    shifts = np.arange(hypotheses) * COLUMNS // hypotheses
    return Query(
        np.zeros((hypotheses, 1)),
        shifts * 2.0 * np.pi / COLUMNS,
        0.0,
        hypotheses == 1,
        CameraHeight(1.5),
        PredictedProfile(log_m[None], np.full((1, COLUMNS), np.log(scale))).moved(shifts),
        PredictedOpenings(rolled(log_probability, shifts), np.array([0.5, 0.2, 0.2, 0.1])),
        **more,
    )


def query_at(prototypes: np.ndarray, number: int, rng: np.random.Generator, *, hypotheses: int = 1) -> Query:
    """Return a noisy prediction at a prototype; the first heading hypothesis is right."""
    row = prototypes[number]
    log_m = np.repeat(row["log_profile"].astype(float), COLUMNS // AZIMUTHS) + rng.normal(0.0, 0.03, COLUMNS)
    kind = np.repeat(unpacked_openings(row["openings"][None])[0], COLUMNS // AZIMUTHS)
    types = np.full(len(ROOM_TYPES), 1.0 / len(ROOM_TYPES))
    ceiling = PredictedCeiling(float(np.log(row["ceiling_m"] - 1.5)), np.log(0.05))
    room_type = PredictedRoomType(np.log(rng.dirichlet(np.ones(len(ROOM_TYPES)))), types)
    return query_of(log_m, 0.05, kind, hypotheses, ceiling=ceiling, room_type=room_type)


def index_of(parts: Sequence[np.ndarray], cells: Cells) -> PlanIndex:
    """Assign the prototypes of each plan to cells and return their index."""
    rows = np.concatenate(parts)
    rows["cell"] = cells.assign(rows)
    count = np.array([len(part) for part in parts])
    return PlanIndex.build(rows, np.cumsum(count) - count, count, step_m=STEP_M, cells=cells)


@pytest.fixture(scope="module")
def prototype_sets() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    plans = [random_plan(rng) for _ in range(20)]
    return [prototypes_of(grid_of(plan), plan) for plan in plans]


def test_prototypes_cover_the_floor() -> None:
    plan = random_plan(np.random.default_rng(1), kinds=("door",))
    grid = grid_of(plan)
    prototypes = prototypes_of(grid, plan)
    assert len(prototypes) == pytest.approx(len(grid.poses) / 2, rel=0.1)
    assert np.exp(prototypes["log_area"]).sum() == pytest.approx(len(grid.poses) * STEP_M**2, rel=1e-5)
    assert set(prototypes["claims"].tolist()) == {1 << OPENING_CLASSES.index("door")}
    kinds = unpacked_openings(prototypes["openings"])
    assert set(kinds.ravel().tolist()) == {0, OPENING_CLASSES.index("door")}
    assert set(prototypes["room_type"].tolist()) == {ROOM_TYPES.index("kitchen"), ROOM_TYPES.index("unknown")}
    np.testing.assert_allclose(prototypes["ceiling_m"], plan.ceiling_heights_m[0], rtol=1e-3)


def test_openings_are_packed_losslessly() -> None:
    kind = np.random.default_rng(0).integers(0, CLASSES, (50, AZIMUTHS)).astype(np.uint8)
    np.testing.assert_array_equal(unpacked_openings(packed_openings(kind)), kind)


def reference_cost(row: Any, query: Query, hypothesis: int, delta: float) -> float:
    """Return the documented cost of `PrototypeCosts`, azimuth by azimuth."""
    assert query.profile is not None and query.openings is not None  # noqa: PT018
    assert query.ceiling is not None and query.room_type is not None  # noqa: PT018
    reach_m = CONFIG.grid_reach * np.sqrt(2.0) * STEP_M
    every, floor = COLUMNS // AZIMUTHS, CONFIG.floor
    centre = query.profile.log_m[hypothesis, ::every]
    scale = np.exp(query.profile.log_scale[hypothesis, ::every])
    walls = 0.0
    for azimuth in range(AZIMUTHS):
        s = np.hypot(scale[azimuth], reach_m * np.exp(-centre[azimuth]))
        r = (float(row["log_profile"][azimuth]) - centre[azimuth] - delta) / (WEIGHTS.tail * s)
        walls += np.log1p(r * r) / AZIMUTHS
    # Openings are blurred by the reach at the median distance.
    spread = reach_m / np.exp(np.median(query.profile.log_m[0, ::every]))
    deviation = spread / (2.0 * np.pi) * COLUMNS
    apart = (np.arange(COLUMNS) + COLUMNS // 2) % COLUMNS - COLUMNS // 2
    kernel = np.exp(-0.5 * np.square(apart / deviation))
    probability = np.exp(query.openings.log_probability[hypothesis])
    blurred = np.stack([np.roll(kernel, w) @ probability for w in range(COLUMNS)]) / kernel.sum()
    openings, kinds = 0.0, unpacked_openings(row["openings"][None])[0]
    for azimuth in range(AZIMUTHS):
        p, prior = blurred[azimuth * every], query.openings.prior
        best = max(floor + (1.0 - floor) * p[c] / prior[c] for c in range(CLASSES))
        if kinds[azimuth] == 0:
            kinds_meant = [c for c in range(CLASSES) if c == 0 or not int(row["claims"]) >> c & 1]
        else:
            kinds_meant = [int(kinds[azimuth])]
        ratio = floor + (1.0 - floor) * p[kinds_meant].sum() / prior[kinds_meant].sum()
        openings += np.log(best / ratio) / AZIMUTHS
    height_m = query.camera_height.height_m * np.exp(delta)
    difference = np.log(float(row["ceiling_m"]) - height_m) - query.ceiling.log_m - delta
    ceiling = np.log1p((difference / (WEIGHTS.tail * np.hypot(np.exp(query.ceiling.log_scale), 0.04))) ** 2)
    ratio = floor + (1.0 - floor) * np.exp(query.room_type.log_probability) / query.room_type.prior
    room_type = np.log(ratio[1:].max()) - (np.log(ratio[row["room_type"]]) if row["room_type"] else 0.0)
    cost = walls + 0.6 * WEIGHTS.openings * openings + WEIGHTS.ceiling * ceiling
    cost += WEIGHTS.room_type * max(room_type, 0.0)
    return cost + float(query.camera_height.penalty(np.array([delta]))[0]) / WEIGHTS.temperature


@pytest.mark.parametrize("kinds", [None, ("door",), ()], ids=["all claimed", "doors claimed", "none claimed"])
def test_prototype_cost_is_the_documented_formula(kinds: tuple[str, ...] | None) -> None:
    rng = np.random.default_rng(3)
    plan = random_plan(rng, kinds=kinds)
    prototypes = prototypes_of(grid_of(plan), plan)
    query = replace(query_at(prototypes, 2, rng, hypotheses=8), camera_height=CameraHeight(1.5, 0.3))
    costs = PrototypeCosts(query, STEP_M, WEIGHTS, CONFIG)
    n, (k, j) = len(prototypes), costs.shape
    assert (k, j) == (8, len(costs.offsets))
    number, hypothesis, offset = rng.integers(n, size=60), rng.integers(k, size=60), rng.integers(j, size=60)
    found = costs.pairs(prototypes[number], hypothesis, offset)
    expected = [
        reference_cost(prototypes[a], query, int(b), float(costs.offsets[c]))
        for a, b, c in zip(number, hypothesis, offset, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3)


def unpacked_codes(code: np.ndarray) -> np.ndarray:
    """Return the values of codes, which hold two per byte."""
    return np.stack([code & 15, code >> 4], axis=2).reshape(len(code), -1)


@pytest.mark.parametrize("kinds", [None, ("door",), ()], ids=["all claimed", "doors claimed", "none claimed"])
def test_code_cost_approximates_the_prototype_cost(kinds: tuple[str, ...] | None) -> None:
    rng = np.random.default_rng(11)
    plan = random_plan(rng, kinds=kinds)
    prototypes = prototypes_of(grid_of(plan), plan)
    query = replace(query_at(prototypes, 2, rng, hypotheses=8), camera_height=CameraHeight(1.5, 0.3))
    # A small ceiling weight keeps the bounded ceiling term from mattering.
    costs = PrototypeCosts(query, STEP_M, replace(WEIGHTS, ceiling=0.02), CONFIG)
    (k, j), n = costs.shape, len(prototypes)
    value = unpacked_codes(product_codes(prototypes))
    (family,) = np.unique(family_of(prototypes["claims"])).tolist()
    tables = lookup_tables(costs, claims_of(family))
    for hypothesis in range(k):
        for offset in range(j):
            coded = tables[hypothesis, offset][np.arange(value.shape[1]), value].sum(axis=1)
            exact = costs.pairs(prototypes, np.full(n, hypothesis), np.full(n, offset))
            np.testing.assert_allclose(coded, exact, atol=0.15)
            assert np.corrcoef(coded, exact)[0, 1] > 0.98


def test_scan_finds_the_lowest_codes_of_the_given_lists() -> None:
    rng = np.random.default_rng(12)
    code, first = rng.integers(0, 256, (500, 25)).astype(np.uint8), np.array([0, 37, 37, 200, 500])
    tables = rng.random((3, 50, 16)).astype(np.float32)
    cost = tables[:, np.arange(50), unpacked_codes(code)].sum(axis=2)
    lists = np.array([[True, False, True, False], [True, True, True, True], [False, False, False, False]])
    found, costs = CodeScan(code, first).search(tables.reshape(3, -1), lists, 250)
    within = np.where(np.arange(500) < 200, cost[0], np.inf)
    assert set(found[0, :200].tolist()) == set(range(200))
    assert (found[0, 200:] == -1).all()
    assert np.isinf(costs[0, 200:]).all()
    np.testing.assert_allclose(costs[0, :200], within[found[0, :200]], atol=0.1)
    # Rounding makes some codes equal.
    assert len(np.intersect1d(found[1], np.argsort(cost[1])[:250])) >= 240
    assert (found[2] == -1).all()


def seen_query(plan: FloorPlan, position_m: tuple[float, float], *, hypotheses: int = 1, turn: float = 0.0) -> Query:
    """Return the exact prediction of walls and openings in a plan's first room; the first heading is off by `turn`."""
    pose = PoseSet(np.array([position_m]), np.zeros(1, int))
    layouts = layouts_at(plan, pose, np.array([turn]), COLUMNS)
    kind = np.zeros(COLUMNS, int) if layouts.kind is None else layouts.kind[0]
    return query_of(layouts.log_profile[0].astype(float), 0.03, kind, hypotheses)


@pytest.mark.parametrize("turn_deg", [-5.0, 0.0, 5.0])
@pytest.mark.parametrize("moved_m", [(0.25, -0.2), (-0.3, 0.1), (0.0, 0.35)])
def test_alignment_finds_the_camera_beside_a_prototype(moved_m: tuple[float, float], turn_deg: float) -> None:
    plan, height_offset = two_rooms(4.3, 3.4), 0.04
    grid = grid_of(plan)
    prototypes, square = prototypes_of(grid, plan), np.rint(grid.poses.position_m / STEP_M).astype(int).sum(axis=1)
    position_m = grid.poses.position_m[square % 2 == 0]
    number = int(np.linalg.norm(position_m - (2.0, 1.5), axis=1).argmin())
    x_m, y_m = position_m[number] + moved_m
    query = seen_query(plan, (x_m, y_m), hypotheses=32, turn=np.radians(turn_deg))
    # The camera stood higher than stated, so predicted distances are too small.
    query = query.scaled(-height_offset)
    # At a high temperature, the prior of the unknowns hardly counts.
    weights, pair = replace(WEIGHTS, temperature=1000.0), (prototypes[[number]], np.array([0]), np.array([0]))
    cost, step = PrototypeAlignment(PrototypeCosts(query, STEP_M, weights, CONFIG)).pairs(*pair)
    np.testing.assert_allclose(step[0, :2], moved_m, atol=0.08)
    assert step[0, 2] == pytest.approx(np.radians(turn_deg), abs=np.radians(1.5))
    assert step[0, 3] == pytest.approx(height_offset, abs=0.03)
    # Alignment compares with half of the reach.
    unmoved = PrototypeCosts(query, 0.5 * STEP_M, weights, CONFIG).pairs(*pair)
    assert cost[0] < 0.6 * unmoved[0]


def test_known_values_are_not_aligned(prototype_sets: list[np.ndarray]) -> None:
    rows, rng = prototype_sets[0][:5], np.random.default_rng(13)
    query = replace(query_at(prototype_sets[0], 3, rng), camera_height=CameraHeight(1.5, 0.0))
    costs = PrototypeCosts(query, STEP_M, WEIGHTS, CONFIG)
    _, step = PrototypeAlignment(costs).pairs(rows, np.zeros(5, int), np.zeros(5, int))
    assert np.abs(step[:, :2]).max() > 0.01
    np.testing.assert_array_equal(step[:, 2:], 0.0)


def furnished_plan(number: int) -> FloorPlan:
    """Return a plan of the same walls for every number, with a door and a window in other places of the first room."""
    document = plan_document(rectangle(4.4, 3.3), rectangle(2.9, 3.0, corner=(4.5, 0.0)), ceiling_m=2.5)
    door_m, window_m, side_m = 0.2 + 0.9 * (number % 3), 0.3 + 1.4 * (number // 3), 3.3 if number % 2 else 0.0
    document["openings"] = [
        {"kind": "door", "line": [[4.45, door_m], [4.45, door_m + 0.9]]},
        {"kind": "window", "line": [[window_m, side_m], [window_m + 1.1, side_m]], "sill_m": 0.9, "head_m": 2.0},
    ]
    return FloorPlan.from_dict(document)


@pytest.mark.parametrize("hypotheses", [1, 32])
def test_plans_that_differ_in_openings_alone_are_told_apart(hypotheses: int) -> None:
    plans, rng, cells = [furnished_plan(number) for number in range(9)], np.random.default_rng(14), shipped_cells()
    parts = [prototypes_of(grid_of(plan), plan) for plan in plans]
    rows, count = np.concatenate(parts), np.array([len(part) for part in parts])
    rows["cell"] = cells.assign(rows)
    begin, limits = np.cumsum(count) - count, SearchLimits(compared=4000, aligned=1000)
    index = PlanIndex.build(rows, begin, count, step_m=STEP_M, cells=cells)
    # The same plans, a third of them added later.
    grown = PlanIndex.build(rows, begin[:6], count[:6], step_m=STEP_M, cells=cells).updated(
        np.arange(6), np.arange(6, 9), lambda numbers: (rows, begin[numbers], count[numbers])
    )
    ranks, grown_ranks = list[int](), list[int]()
    for number, plan in enumerate(plans):
        # Cameras between prototypes, and between hypotheses of the heading.
        x_m, y_m = rng.uniform((1.2, 1.2), (3.2, 2.2)).tolist()
        query = seen_query(plan, (x_m, y_m), hypotheses=hypotheses, turn=0.08 if hypotheses > 1 else 0.0)
        mass, grown_mass = (each.whole.log_masses(query, WEIGHTS, CONFIG, limits) for each in (index, grown))
        ranks.append(int((mass > mass[number]).sum()))
        grown_ranks.append(int((grown_mass > grown_mass[number]).sum()))
    assert ranks.count(0) >= 7
    assert max(ranks) <= 2
    assert grown_ranks == ranks
    unaligned = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=4000, aligned=0))
    one = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=4000, aligned=1))
    # All plans but that of the only aligned pair change alike.
    assert len(set(np.round(one - unaligned, 6).tolist())) <= 2
    assert len(set(np.round(mass - unaligned, 6).tolist())) > 2
    # By walls alone, all plans are equal.
    walls = index.whole.log_masses(
        query, WEIGHTS, replace(CONFIG, use_openings=False), SearchLimits(compared=10**9, aligned=10**9)
    )
    np.testing.assert_allclose(walls, walls[0], atol=1e-3)


def test_mass_sums_over_prototypes_and_hypotheses(prototype_sets: list[np.ndarray]) -> None:
    few, rng = prototype_sets[:4], np.random.default_rng(4)
    query = query_at(few[1], 3, rng, hypotheses=4)
    alignment = PrototypeAlignment(PrototypeCosts(query, STEP_M, WEIGHTS, CONFIG))
    index = index_of(few, shipped_cells())
    expected = []
    for part in few:
        offset = np.zeros(len(part), int)
        cost = np.stack([alignment.pairs(part, np.full(len(part), k), offset)[0] for k in range(4)])
        weighed = part["log_area"] - WEIGHTS.temperature * cost.astype(float)
        expected.append(np.logaddexp.reduce(weighed, axis=None))
    found = index.whole.log_masses(query, WEIGHTS, CONFIG)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert found.argmax() == 1


@pytest.mark.slow
def test_few_comparisons_find_the_best_plan(prototype_sets: list[np.ndarray]) -> None:
    index, rng = index_of(prototype_sets, shipped_cells()), np.random.default_rng(5)
    pairs = sum(map(len, prototype_sets)) * 16
    for number in range(len(prototype_sets)):
        query = query_at(prototype_sets[number], 5, rng, hypotheses=16)
        whole = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=pairs))
        few = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=pairs // 40, scanned=pairs // 10))
        with ThreadPoolExecutor(1) as helper:
            halved = index.whole.log_masses(
                query, WEIGHTS, CONFIG, SearchLimits(compared=pairs // 40, scanned=pairs // 10), helper=helper
            )
        np.testing.assert_array_equal(halved, few)
        assert few[whole.argmax()] > few.max() - 0.1
        # Skipped comparisons contribute no mass.
        assert (few <= whole + 1e-6).all()
        assert few.max() == pytest.approx(whole.max(), abs=0.7)


def test_unknown_camera_height_is_searched(prototype_sets: list[np.ndarray]) -> None:
    query = query_at(prototype_sets[7], 4, np.random.default_rng(6))
    # The camera stood at 1.95 m, not at 1.5 m, so predicted distances are too small.
    smaller = replace(present(query.profile), log_m=present(query.profile).log_m - np.log(1.3))
    unknown = replace(query, profile=smaller, ceiling=None, camera_height=CameraHeight(1.5, float("inf")))
    index = index_of(prototype_sets, shipped_cells())
    assert index.whole.log_masses(unknown, WEIGHTS, CONFIG).argmax() == 7
    assert index.whole.log_masses(unknown, WEIGHTS, CONFIG, SearchLimits(compared=2000)).argmax() == 7


def test_copies_have_equal_masses_for_any_limit(prototype_sets: list[np.ndarray]) -> None:
    several = [*prototype_sets, prototype_sets[3], prototype_sets[3]]
    index, rng = index_of(several, shipped_cells()), np.random.default_rng(7)
    for compared, scanned in ((50, 2000), (50, 10**9), (50, 1000), (10**9, 1)):
        query = query_at(prototype_sets[3], 1, rng, hypotheses=8)
        masses = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=compared, scanned=scanned))
        assert np.isfinite(masses[3])
        np.testing.assert_allclose(masses[[20, 21]], masses[3], rtol=0, atol=1e-9)


def test_updated_index_equals_a_new_one(prototype_sets: list[np.ndarray]) -> None:
    """Plans come and go one by one and many at once, in any order, with copies of each other in several segments."""
    rng, cells = np.random.default_rng(12), shipped_cells()
    rows = np.concatenate(prototype_sets)
    rows["cell"] = cells.assign(rows)
    count = np.array([len(part) for part in prototype_sets])
    begin = np.cumsum(count) - count
    queries = [query_at(prototype_sets[number], 1, rng, hypotheses=8) for number in (0, 3, 19)]

    def located(plans: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return rows, begin[plans], count[plans]

    plans = list(range(12))
    index = PlanIndex.build(*located(plans), step_m=STEP_M, cells=cells)
    # Number 40 + k is a copy of plan k: another plan with equal prototypes.
    for wanted in (
        [*range(12), 12],
        [13, *range(13)],
        [13, *range(3), *range(4, 13)],
        [43, 13, *range(13)],
        [43, 13, *range(12, -1, -1), *range(14, 20)],
        [43, 53, 3, 13, 19],
        [19],
        [*range(20), 59],
        # Copies in one segment, of which one is removed: no prototype is without an owner.
        [3, 43, 5, 45],
        [3, 5, 45],
    ):
        place = np.array([wanted.index(plan) if plan in wanted else -1 for plan in plans])
        added = np.array([number for number, plan in enumerate(wanted) if plan not in plans], int)
        index = index.updated(place, added, lambda numbers, wanted=wanted: located([wanted[n] % 40 for n in numbers]))
        fresh = PlanIndex.build(*located([plan % 40 for plan in wanted]), step_m=STEP_M, cells=cells)
        sizes = [part.plans for part in index.parts]
        assert sum(sizes) == index.plan_count == len(wanted)
        assert all(before >= 2 * after for before, after in pairwise(sizes))
        for query in queries:
            for compared, scanned in ((10**9, 1), (400, 10**9)):
                limits = SearchLimits(compared=compared, scanned=scanned)
                masses = index.whole.log_masses(query, WEIGHTS, CONFIG, limits)
                expected = fresh.whole.log_masses(query, WEIGHTS, CONFIG, limits)
                compares_copies_twice = compared < 10**9 and max(wanted) > 40
                if not compares_copies_twice:
                    np.testing.assert_allclose(masses, expected, rtol=0, atol=1e-9)
                assert masses.argmax() == expected.argmax()
                for copy in (number for number, plan in enumerate(wanted) if plan >= 40 and plan - 40 in wanted):
                    assert masses[copy] == pytest.approx(masses[wanted.index(wanted[copy] - 40)], abs=1e-9)
        plans = wanted


def test_divided_index_equals_an_undivided_one(prototype_sets: list[np.ndarray]) -> None:
    rng, cells = np.random.default_rng(15), shipped_cells()
    index, order = index_of(prototype_sets, cells), rng.permutation(len(prototype_sets))
    shards = [
        (index_of([prototype_sets[number] for number in numbers], cells), numbers)
        for numbers in np.split(order, [3, 4, 13])
    ]
    divided = DividedIndex(shards=shards, step_m=STEP_M, cells=cells)
    pairs = 16 * len(index)
    for number in range(0, len(prototype_sets), 3):
        query = query_at(prototype_sets[number], 2, rng, hypotheses=16)
        for compared, scanned in ((pairs, 1), (pairs // 40, pairs), (pairs // 40, pairs // 10)):
            limits = SearchLimits(compared=compared, scanned=scanned, aligned=300)
            masses, expected = (each.log_masses(query, WEIGHTS, CONFIG, limits) for each in (divided, index.whole))
            np.testing.assert_allclose(masses, expected, rtol=0, atol=1e-9)


def test_search_sent_to_another_machine_has_the_same_costs(prototype_sets: list[np.ndarray]) -> None:
    search = PlanSearch(query_at(prototype_sets[0], 2, np.random.default_rng(16)), STEP_M, WEIGHTS, CONFIG)
    alone = len(pickle.dumps(search))
    search.costs.opening_loss(claims_of(FAMILIES - 1))
    sent = pickle.dumps(search)
    assert len(sent) < 2 * alone
    loss = search.costs.opening_loss(claims_of(FAMILIES - 1))
    np.testing.assert_array_equal(pickle.loads(sent).costs.opening_loss(claims_of(FAMILIES - 1)), loss)


@pytest.mark.parametrize(
    ("trust", "level"),
    [
        ({}, [0, 0, 0]),
        ({"door": 1.0, "window": 1.0, "passage": 1.0}, [1, 1, 1]),
        ({"door": 0.9, "window": 0.7, "passage": 0.3}, [1, 0.75, 0.35]),
    ],
)
def test_claims_keep_the_nearest_level_of_each_trust(trust: dict[str, float], level: list[float]) -> None:
    assert trust_of_claims(claims_of_trust(trust)) == [0.0, *level]


def test_claims_of_complete_kinds_are_those_of_earlier_databases() -> None:
    assert claims_of_trust({"door": 1.0, "passage": 1.0}) == 0b1010
    assert [trust_of_claims(claims_of(family)) for family in (0, 5)] == [[0, 0, 0, 0], [0, 1, 0, 1]]


def test_plans_with_and_without_openings_are_found() -> None:
    rng, cells = np.random.default_rng(8), shipped_cells()
    whole, prototype_sets = list[np.ndarray](), list[np.ndarray]()
    for number in range(12):
        complete, bare = (random_plan(np.random.default_rng(number), kinds=kinds) for kinds in (None, ()))
        whole.append(prototypes_of(grid_of(complete), complete))
        prototype_sets.append(prototypes_of(grid_of(bare), bare) if number % 2 else whole[-1])
    rows = np.concatenate(prototype_sets)
    rows["cell"] = cells.assign(rows)
    # Family 0 has no openings, family 3 has doors and windows.
    assert np.unique(rows["cell"] // (len(cells) // FAMILIES)).tolist() == [0, 3]
    assert np.unique(family_of(rows["claims"])).tolist() == [0, 3]
    index = index_of(prototype_sets, cells)
    for number in range(12):
        query = query_at(whole[number], 2, rng, hypotheses=8)
        masses = index.whole.log_masses(query, WEIGHTS, CONFIG, SearchLimits(compared=3000))
        assert (masses > masses[number]).sum() <= (2 if number % 2 else 0)


def test_cell_cost_approximates_the_prototype_cost(prototype_sets: list[np.ndarray]) -> None:
    # Each cell has a single prototype.
    rows = np.concatenate(prototype_sets)[:50]
    share = (unpacked_openings(rows["openings"])[:, :, None] == np.arange(CLASSES)).astype(np.float32)
    cells = Cells(rows["log_profile"].astype(np.float32), share, version=1)
    rows["claims"] = sum(1 << code for code in range(1, CLASSES))
    family = FAMILIES - 1
    assert cells.assign(rows).tolist() == list(range(family * 50, family * 50 + 50))
    query = query_at(prototype_sets[0], 1, np.random.default_rng(9), hypotheses=4)
    query = replace(query, ceiling=None, room_type=None)
    costs = PrototypeCosts(query, STEP_M, WEIGHTS, CONFIG)
    by_cell = cells.costs(costs, [family])[family]
    for hypothesis in range(4):
        exact = costs.pairs(rows, np.full(50, hypothesis), np.zeros(50, int))
        np.testing.assert_allclose(by_cell[:, hypothesis, 0], exact, atol=0.1)


PLANS = [
    two_rooms(4.0, 3.0, kinds=("door",)),
    two_rooms(7.0, 2.0, x_m=1e6, kinds=()),
    two_rooms(5.0, 5.0, kinds=("door",)),
]


@pytest.fixture(scope="module")
def merged_plans() -> MergedPlans:
    return MergedPlans.of(PLANS, [grid_of(plan) for plan in PLANS], 1.5)


def opening_query() -> Query:
    """Return a query that sees a door in a third of the horizon."""
    plain = Query(np.zeros((1, 1)), np.zeros(1), 0.0, True, CameraHeight(1.5))
    log_m = np.full((1, COLUMNS), np.log(2.0))
    seen = np.full((COLUMNS, CLASSES), 0.1)
    seen[np.arange(COLUMNS), np.where(np.arange(COLUMNS) < COLUMNS // 3, OPENING_CLASSES.index("door"), 0)] = 0.7
    openings = PredictedOpenings(np.log(seen)[None], np.array([0.7, 0.1, 0.1, 0.1]))
    return replace(plain, profile=PredictedProfile(log_m, np.full_like(log_m, np.log(0.05))), openings=openings)


@pytest.mark.parametrize("azimuths", [SPHERE_AZIMUTHS, VIEW_AZIMUTHS])
def test_each_merged_plan_has_its_own_trust_in_openings(azimuths: int) -> None:
    trusts = [{"door": 1.0}, {}, {"door": 0.5}]
    plans = [replace(plan, opening_trust=trust) for plan, trust in zip(PLANS, trusts, strict=True)]
    merged, query = MergedPlans.of(plans, [grid_of(plan) for plan in plans], 1.5), opening_query()
    cost = MatchingCost(merged.plan, query, 0.3, WEIGHTS, CONFIG)
    layouts, room_index = merged.grid.layouts(merged.plan), merged.grid.poses.room_index
    binned = BinnedLayouts.of(layouts, azimuths)
    coarse = coarse_costs(binned, cost, room_index)
    assert (CoarseTable(binned, cost).bounds(binned, room_index) <= coarse.min(axis=1)).all()
    own = [MatchingCost(plan, query, 0.3, WEIGHTS, CONFIG) for plan in plans]
    exact = np.split(cost.costs(layouts)[0][0], np.cumsum([len(grid_of(plan).poses) for plan in plans])[:-1])
    shifts = []
    for plan, alone, found, part in zip(
        plans, own, exact, np.split(coarse, np.cumsum(list(map(len, exact)))[:-1]), strict=True
    ):
        grid = grid_of(plan)
        difference = found - alone.costs(grid.layouts(plan))[0][0]
        np.testing.assert_allclose(difference, difference[0], atol=1e-5)
        estimate = part[:, 0] - coarse_costs(grid.binned(plan, azimuths), alone, grid.poses.room_index)[:, 0]
        np.testing.assert_allclose(estimate, estimate[0], atol=1e-5)
        shifts.append(float(difference[0]))
    # Without a constant cost, plans that show fewer openings would always cost less.
    assert shifts[1] > shifts[2] > shifts[0] >= 0.0


def test_merged_layouts_equal_those_of_each_plan(merged_plans: MergedPlans) -> None:
    separate = [grid_of(plan).layouts(plan) for plan in PLANS]
    merged = merged_plans.grid.layouts(merged_plans.plan)
    assert merged.kind is not None
    assert merged.seen is not None
    assert len(merged) == sum(map(len, separate))
    first = 0
    for layouts in separate:
        rows = merged.rows(np.arange(first, first + len(layouts)))
        assert rows.kind is not None
        np.testing.assert_array_equal(rows.log_profile, layouts.log_profile)
        np.testing.assert_array_equal(rows.kind, np.zeros_like(rows.kind) if layouts.kind is None else layouts.kind)
        seen = 0 if layouts.seen is None else len(layouts.seen.row)
        assert seen == (0 if rows.seen is None else len(rows.seen.row))
        first += len(layouts)


def test_merged_plan_renders_like_each_plan(merged_plans: MergedPlans) -> None:
    grid = merged_plans.grid
    seen = profiles_at(
        merged_plans.plan, grid.poses.position_m, grid.poses.room_index, np.zeros(len(grid.poses)), COLUMNS, np.float32
    )
    np.testing.assert_allclose(seen, grid.profile_m, atol=2e-3)


def test_merged_rooms_map_to_their_plans(merged_plans: MergedPlans) -> None:
    separate = [grid_of(plan).poses for plan in PLANS]
    sizes = [len(poses) for poses in separate]
    room_index, last = merged_plans.grid.poses.room_index, np.cumsum(sizes)
    expected = np.repeat(np.arange(len(sizes)), sizes).tolist()
    assert [merged_plans.plan_of(int(room)) for room in room_index] == expected
    np.testing.assert_array_equal(merged_plans.by_plan(np.ones(len(room_index))), sizes)
    # No two plans are near each other.
    parts = np.split(merged_plans.grid.poses.position_m, last[:-1])
    for k, part in enumerate(parts):
        for later in parts[k + 1 :]:
            assert np.linalg.norm(part[:, None] - later[None], axis=-1).min() > 9.0
    assert np.abs(merged_plans.grid.poses.position_m).max() < 100.0


def test_most_probable_plans_are_searched_within_limits() -> None:
    log_mass, poses = np.array([-3.0, -1.0, -2.0, -9.0]), np.array([10, 500, 20, 30])
    assert most_probable(log_mass, poses, max_plans=3, max_poses=1000).tolist() == [1, 2, 0]
    assert most_probable(log_mass, poses, max_plans=2, max_poses=1000).tolist() == [1, 2]
    assert most_probable(log_mass, poses, max_plans=4, max_poses=525).tolist() == [1, 2]
    assert most_probable(log_mass, poses, max_plans=4, max_poses=5).tolist() == [1]
    # Plans without mass are skipped.
    log_mass = np.array([-np.inf, -1.0, -np.inf, -9.0])
    assert most_probable(log_mass, poses, max_plans=4, max_poses=1000).tolist() == [1, 3]


def test_copies_of_a_plan_are_chosen_in_their_order() -> None:
    rounding = np.array([0.0, 1e-9, -1e-9, 2e-9])
    for log_mass in (-1.0 + rounding, -1.0 + rounding[::-1]):
        assert most_probable(log_mass, np.ones(4, np.int64), max_plans=2, max_poses=100).tolist() == [0, 1]


def test_plans_left_out_keep_their_share() -> None:
    copies = np.full(10, -2.0)
    assert share_searched(copies, np.arange(10), np.full(10, 0.1)) == 1.0
    # Four of ten copies were searched: each has a quarter of their mass, a tenth of all.
    assert share_searched(copies, np.arange(4), np.full(4, 0.25)) == pytest.approx(0.4)
    # One plan dominates the full search, so plans left out count as wrong.
    sharp = np.array([1.0 - 3e-5, 1e-5, 1e-5, 1e-5])
    assert share_searched(copies, np.arange(4), sharp) > 0.99
    # A wrong plan and one of four copies of the right plan were searched.
    mixed = np.array([-1.0, -2.0, -2.0, -2.0, -2.0, -7.0])
    assert share_searched(mixed, np.arange(2), np.array([0.0, 1.0])) == pytest.approx(0.25, abs=0.01)
    # Plans without mass change nothing.
    more = np.append(mixed, [-np.inf, -np.inf])
    assert share_searched(more, np.arange(2), np.array([0.0, 1.0])) == pytest.approx(0.25, abs=0.01)
