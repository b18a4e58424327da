"""Search among very many plans: speed and recall of the index of prototypes.

    python -m benchmarks.venues index --plans 2000 --queries 20 --exact 1e9
    python -m benchmarks.venues index --plans 2500 --repeat 40 --queries 12 --exact 0
    python -m benchmarks.venues search --plans 400 --queries 24

Generated homes take the place of real ones; queries are rendered photographs of some of them, encoded by the model.
Times are processor times of one thread.

`index` compares the index with brute force. `--repeat` adds variants of each home: stretched along both axes, with
other ceilings, turned by quarters and mirrored at random. Their prototypes are computed from those of the home, exactly
up to interpolation between azimuths. Brute force compares all prototypes under all hypotheses where that is at most
`--exact` pairs (half a minute for every 100 million); beyond, it compares all of them by codes and the best million
exactly. It aligns the best hundred thousand.

`search` localises each query twice with the production search and LPO: among the plans that the index chooses, as the
service does, and among all plans.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import argument_parser
from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, RenderedPhotograph, split_renderer_cache
from lalaloc_core.learn.synth.homes.splits import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.encode.encoders import Encoders
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.localise.venue.index_search import ALIGNED, COMPARED, SCANNED, SearchLimits
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from lalaloc_core.localise.venue.prototypes import (
    AZIMUTHS,
    most_probable,
    packed_openings,
    prototypes_of,
    unpacked_openings,
)
from scripts.make_prototype_cells import grid_without_latents
from service.query.venue_localiser import VENUE_CONFIG
from service.settings import Settings
from service.venues.prototype_file import BlockKey, PrototypeFile
from service.venues.venue_plans import MAX_SEARCHED, most_poses

_TEST = SPLIT_NUMBERS["test"]
_FIRST = 20
# Variants are longer and wider by at most this share.
_MAX_STRETCH = 0.1
# Pairs that brute force compares exactly where it compares all pairs by codes.
_MAX_COMPARED = 1_000_000
# Pairs that brute force aligns.
_MAX_ALIGNED = 100_000
_STEP_M = 0.5
# Homes that `recall` generates at most; further plans are variants of them. Ranks within which it counts right plans.
_HOMES, _RANKS = 2500, (1, 20, 128)

_Figures = defaultdict[str, defaultdict[str, list[Any]]]


def prototypes(plans: int, seed: int) -> list[np.ndarray]:
    """Return the prototypes of homes, sorted into cells."""
    blocks = []
    for number in range(plans):
        home, _ = home_of(_TEST, seed, number)
        rows = prototypes_of(grid_without_latents(home), home.plan).rows
        rows["cell"] = shipped_cells().assign(rows)
        blocks.append(rows)
        if number % 1000 == 999:
            print(f"  {number + 1} homes", file=sys.stderr, flush=True)
    return blocks


def repeated(blocks: list[np.ndarray], times: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return each plan and variants of it."""
    found = list(blocks)
    for number in range(1, times):
        variants = [_variant(block, rng) for block in blocks]
        # One sort of all variants is faster than one per variant.
        cell = shipped_cells().assign(np.concatenate(variants))
        ends = np.cumsum([len(block) for block in variants])
        for block, own in zip(variants, np.split(cell, ends[:-1]), strict=True):
            block["cell"] = own
        found += variants
        if number % 5 == 4:
            print(f"  {len(found)} plans", file=sys.stderr, flush=True)
    return found


def _variant(block: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return prototypes of a plan stretched along both axes, turned by quarters and mirrored at random."""
    rows, (x, y) = block.copy(), 1.0 + rng.uniform(-_MAX_STRETCH, _MAX_STRETCH, 2)
    azimuth = 2.0 * np.pi / AZIMUTHS * np.arange(AZIMUTHS)
    # Stretching moves a point to another azimuth and distance.
    before = np.arctan2(np.sin(azimuth) / y, np.cos(azimuth) / x)
    farther = -0.5 * np.log(np.square(np.cos(azimuth) / x) + np.square(np.sin(azimuth) / y))
    place = before / (2.0 * np.pi) * AZIMUTHS % AZIMUTHS
    lower, share = place.astype(int), place % 1.0
    log_profile = block["log_profile"].astype(np.float32)
    between = (1.0 - share) * log_profile[:, lower % AZIMUTHS] + share * log_profile[:, (lower + 1) % AZIMUTHS]
    order = np.roll(np.arange(AZIMUTHS), rng.integers(4) * AZIMUTHS // 4)
    order = -order % AZIMUTHS if rng.random() < 0.5 else order
    rows["log_profile"] = (between + farther)[:, order]
    kind = unpacked_openings(block["openings"])[:, np.rint(place).astype(int) % AZIMUTHS]
    rows["openings"] = packed_openings(kind[:, order])
    rows["log_area"] += np.log(x * y)
    rows["ceiling_m"] += rng.normal(0.0, 0.1)
    return rows


def queries(bundle: Bundle, homes: list[int], seed: int) -> Iterator[tuple[int, str, Query]]:
    """Yield queries with a photograph of each home: its number, the known values, the query."""
    encoders, renderers = Encoders(bundle, threads=1), split_renderer_cache(_TEST, seed, None)
    size = bundle.manifest.image_height, bundle.manifest.image_width
    for number in homes:
        home, rng = home_of(_TEST, seed, number)
        shot = sample_shots(home, 1, rng, "full")[0]
        image = RenderedPhotograph(shot, renderers).image(*size)
        known, unknown = CameraHeight(shot.camera_height_m), CameraHeight(1.5, float("inf"))
        yield number, "heading known", encoders.query(image, shot.heading, known)
        yield number, "heading unknown", encoders.query(image, None, known)
        yield number, "heading and height unknown", encoders.query(image, None, unknown)


def recall(bundle: Bundle, plans: int, photographs: int, seed: int = 0) -> dict[str, dict[str, float]]:
    """Return how often the index ranks the right plan among the first ones, with and without alignment, and its time.

    Args:
        bundle: the model.
        plans: number of plans, homes and variants of them.
        photographs: number of photographs, each of another home where there are as many.
        seed: seed of the homes.
    """
    homes = min(plans, _HOMES)
    blocks = repeated(prototypes(homes, seed), plans // homes, np.random.default_rng(seed))
    count = np.array([len(block) for block in blocks])
    rows, cells = np.concatenate(blocks), shipped_cells()
    index = PlanIndex.build(rows, np.cumsum(count) - count, count, step_m=_STEP_M, cells=cells)
    index.prepare()
    columns: dict[str, list[tuple[int, float]]] = defaultdict(list)
    photographed = np.linspace(0, homes - 1, photographs).astype(int).tolist()
    for number, name, query in queries(bundle, photographed, seed):
        for aligned, shown in ((0, f"{name}, not aligned"), (ALIGNED, name)):
            begin = time.process_time()
            mass = index.whole.log_masses(
                query, bundle.manifest.evidence, MatchingConfig(), SearchLimits(aligned=aligned)
            )
            seconds = time.process_time() - begin
            columns[shown].append((int((mass > mass[number]).sum()), seconds))
    return {
        name: {
            "plans": len(blocks),
            "n": len(values),
            **{f"right_among_{first}": float(np.mean([rank < first for rank, _ in values])) for first in _RANKS},
            "cpu_ms_p50": round(1e3 * float(np.median([seconds for _, seconds in values])), 1),
        }
        for name, values in columns.items()
    }


def measure_index(options: argparse.Namespace, bundle: Bundle) -> None:
    """Print times and recall of the index."""
    blocks = repeated(prototypes(options.plans, options.seed), options.repeat, np.random.default_rng(options.seed))
    count = np.array([len(block) for block in blocks])
    print(f"{len(blocks)} plans, {count.sum()} prototypes of {blocks[0].itemsize} bytes")
    weights, config = bundle.manifest.evidence, MatchingConfig()
    figures: _Figures = defaultdict(lambda: defaultdict(list))
    with tempfile.TemporaryDirectory() as folder:
        path, cells = Path(folder) / "prototypes.bin", shipped_cells()
        keys = [BlockKey(number, "0" * 64) for number in range(len(blocks))]
        begin = time.process_time()
        file = PrototypeFile(path, cells_version=cells.version, limit_bytes=2**40)
        file.add(dict(zip(keys, blocks, strict=True)))
        written = time.process_time()
        file.close()
        file = PrototypeFile(path, cells_version=cells.version, limit_bytes=2**40)
        opened = time.process_time()
        found = file.find(keys)
        first = np.array([found[key][0] for key in keys])
        index = PlanIndex.build(file.rows(), first, count, step_m=_STEP_M, cells=cells)
        built = time.process_time()
        index.prepare()
        print(
            f"written in {written - begin:.2f} s, opened in {opened - written:.2f} s, index in {built - opened:.2f} s, "
            f"its codes in {time.process_time() - built:.2f} s, {index.nbytes / 1e6:.0f} MB",
            flush=True,
        )
        homes = np.linspace(0, options.plans - 1, options.queries).astype(int).tolist()
        for number, name, query in queries(bundle, homes, options.seed):
            pairs = int(count.sum()) * min(len(query.roll), AZIMUTHS) * len(query.camera_height.offsets)
            reference, compared = ("brute force", 10**15) if pairs <= options.exact else ("all codes", _MAX_COMPARED)
            limits = SearchLimits(compared=compared, scanned=10**15, aligned=_MAX_ALIGNED)
            exact = _ranked(index.whole.log_masses(query, weights, config, limits))
            for scanned in options.scanned:
                begin, began = time.process_time(), time.perf_counter()
                fewer = SearchLimits(compared=options.compared, scanned=int(scanned))
                mass = index.whole.log_masses(query, weights, config, fewer)
                columns = figures[f"{name}, {scanned:,.0f} pairs by codes"]
                columns["ms"].append(1e3 * (time.process_time() - begin))
                columns["ms of wall clock"].append(1e3 * (time.perf_counter() - began))
                ranked = _ranked(mass)
                columns["right plan in the first 20"].append(number in ranked[:_FIRST])
                columns["right plan in the first 128"].append(number in ranked[:128])
                shared = np.intersect1d(ranked[:_FIRST], exact[:_FIRST])
                columns[f"{reference}: recall of 20"].append(len(shared) / _FIRST)
                columns[f"{reference}: its first in the first 20"].append(exact[0] in ranked[:_FIRST])
                columns[f"{reference}: right plan in the first 20"].append(number in exact[:_FIRST])
        file.close()
    for name, columns in figures.items():
        print(f"{name}, n = {options.queries}")
        for column, values in columns.items():
            if column.startswith("ms"):
                print(f"  {column}: p50 {np.median(values):.0f}, p95 {np.percentile(values, 95):.0f}")
            else:
                print(f"  {column}: {np.mean(values):.1%} of {len(values)}")


def measure_search(options: argparse.Namespace, bundle: Bundle) -> None:
    """Print shares of right plans and times of the full search."""
    limit, encoders, refiner = Settings.load().grids.max_grid_poses, Encoders(bundle, threads=1), local_refiner(bundle)
    homes = [home_of(_TEST, options.seed, number)[0] for number in range(options.plans)]
    plans, grids = [home.plan for home in homes], [grid_without_latents(home) for home in homes]
    parts = [prototypes_of(grid, plan) for grid, plan in zip(grids, plans, strict=True)]
    index, poses = PlanIndex.from_prototypes(parts, shipped_cells()), np.array([len(grid.poses) for grid in grids])

    def best_plan(query: Query, chosen: list[int]) -> int:
        merged = MergedPlans.of([plans[k] for k in chosen], [grids[k] for k in chosen], query.camera_height.height_m)
        answer = localise(merged.plan, merged.grid, encoders, query, refiner=refiner, config=VENUE_CONFIG)
        return chosen[merged.in_own_plan(answer.candidates[0])[0]]

    figures: _Figures = defaultdict(lambda: defaultdict(list))
    photographed = np.linspace(0, options.plans - 1, options.queries).astype(int).tolist()
    for number, name, query in queries(bundle, photographed, options.seed):
        begin = time.process_time()
        mass = index.whole.log_masses(query, bundle.manifest.evidence, MatchingConfig())
        chosen = most_probable(mass, poses, max_plans=MAX_SEARCHED, max_poses=most_poses(query, limit)).tolist()
        indexed = time.process_time()
        by_index = best_plan(query, chosen)
        searched = time.process_time()
        by_all = best_plan(query, list(range(options.plans)))
        columns = figures[name]
        columns["plans searched"].append(len(chosen))
        columns["right plan among them"].append(number in chosen)
        columns["right plan first by the index alone"].append(number == int(mass.argmax()))
        columns["right plan first by index and full search"].append(number == by_index)
        columns["right plan first by full search of all"].append(number == by_all)
        columns["the same first plan"].append(by_index == by_all)
        times_s = [indexed - begin, searched - indexed, time.process_time() - searched]
        columns["s of index, of full search, of full search of all"].append(times_s)
    for name, columns in figures.items():
        print(f"{name}, n = {options.queries}")
        for column, values in columns.items():
            print(f"  {column}: {np.round(np.mean(values, axis=0), 3)}")


def _ranked(mass: np.ndarray) -> np.ndarray:
    return np.argsort(-mass, kind="stable")


def main() -> None:
    """Measure the index or the search."""
    parser = argument_parser(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    index = commands.add_parser("index", help="index of prototypes against brute force")
    search = commands.add_parser("search", help="index and full search against full search of all plans")
    for command, plans, count in ((index, 2000, 20), (search, 400, 24)):
        command.add_argument("--bundle", type=Path, default=Path("models/default"))
        command.add_argument("--plans", type=int, default=plans, help="generated homes")
        command.add_argument("--queries", type=int, default=count)
        command.add_argument("--seed", type=int, default=0)
    index.add_argument("--repeat", type=int, default=1, help="plans made of each home, itself included")
    index.add_argument("--compared", type=int, default=COMPARED, help="pairs that the index compares exactly")
    index.add_argument("--scanned", type=float, nargs="+", default=[SCANNED], help="pairs it compares by codes")
    index.add_argument("--exact", type=float, default=1e9, help="maximum pairs that brute force compares per query")
    options = parser.parse_args()
    measure = measure_index if options.command == "index" else measure_search
    measure(options, Bundle.open(options.bundle))


if __name__ == "__main__":
    main()
