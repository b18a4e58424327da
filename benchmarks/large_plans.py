"""Preparing and searching plans by area: `python -m benchmarks.large_plans`.

Buildings are generated homes side by side, with corridors between them and halls full of columns
(`learn.synth.homes.buildings`); photographs are of their homes. Times are processor times of one thread, so that the
machine need not be idle; memory is that of the pose grid with everything that queries derive from it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.harness import argument_parser, print_table_head, table_row
from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.floorplan import FloorPlan, PlanLimits
from lalaloc_core.learn.data.synthetic.generated import RendererCache
from lalaloc_core.learn.synth.homes.buildings import Building, building_of
from lalaloc_core.learn.synth.homes.plans import VALIDATION
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig, PoseGrid
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.localise.search.retrieval import grid_costs
from service.grids.embedding import embed, grid_bytes

# Buildings are a little larger than asked for; the limit is 200,000 m².
_AREAS_M2 = (100.0, 1000.0, 5000.0, 10_000.0, 50_000.0, 100_000.0, 190_000.0)
# Homes side by side have more openings than the default limit.
_MAX_OPENINGS = 30_000
_STEP_M = 0.5
_T = TypeVar("_T")


def main() -> None:
    """Measure every building and print the table."""
    parser = argument_parser(__doc__)
    parser.add_argument("--areas", type=float, nargs="+", default=list(_AREAS_M2), help="m²")
    parser.add_argument("--queries", type=int, default=8, help="photographs per building")
    parser.add_argument("--bundle", type=Path, default=default_bundle())
    parser.add_argument("--textures", type=Path, help="folder of textures")
    arguments = parser.parse_args()
    bundle = Bundle.open(arguments.bundle)
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(1), arguments.textures))
    head = "area m², rooms, poses, read, ready, grid and a pose, known, unknown, retrieval"
    print_table_head(*head.split(", "))
    for area_m2 in arguments.areas:
        building = building_of(VALIDATION, 0, area_m2, hall_share=0.2 if area_m2 > 1000.0 else 0.0)
        print(table_row(*_measure(building, bundle, renderers, arguments.queries)), flush=True)


def _measure(building: Building, bundle: Bundle, renderers: RendererCache, count: int) -> Iterator[str]:
    encoders = PhotographEncoder(bundle, threads=1)
    document, limits = building.plan.to_dict(), PlanLimits(max_openings=_MAX_OPENINGS)
    read_s, plan = _time_of(lambda: FloorPlan.from_dict(document, limits))
    ready_s, grid = _time_of(lambda: _prepared(plan, encoders))
    megabytes = grid_bytes(grid) / 1e6
    yield from (f"{plan.area_m2:,.0f}", f"{len(plan.rooms):,}", f"{len(grid.poses):,}")
    yield from (f"{read_s:.2f} s", f"{ready_s:.2f} s")
    yield f"{megabytes:.1f} MB, {1e3 * megabytes / len(grid.poses):.2f} kB"
    rng = np.random.default_rng(5)
    shots = [sample_shots(building.homes[home], 1, rng)[0] for home in rng.integers(len(building.homes), size=count)]
    refiner, config, weights = local_refiner(bundle), MatchingConfig(), encoders.manifest.evidence
    height, width = encoders.manifest.image_height, encoders.manifest.image_width
    images = [renderers.renderer(height, width).render([shot]).cpu().numpy()[0] for shot in shots]

    def query(number: int, *, known: bool) -> Query:
        shot = shots[number]
        heading = shot.heading if known else None
        return encoders.spheres.query(images[number], heading, CameraHeight(shot.camera_height_m))

    def search(number: int, *, known: bool) -> None:
        localise(plan, grid, encoders.layouts, query(number, known=known), refiner=refiner)

    for known in (True, False):
        search(0, known=known)
        times = [_time_of(partial(search, number, known=known))[0] for number in range(count)]
        yield f"{1e3 * statistics.median(times):.0f} ms"
    unknown = [query(number, known=False) for number in range(count)]
    times = [_time_of(partial(grid_costs, plan, grid, each, weights, config))[0] for each in unknown]
    yield f"{1e3 * statistics.median(times):.0f} ms"


def _prepared(plan: FloorPlan, encoders: PhotographEncoder) -> PoseGrid:
    grid = embed(plan, encoders, step_m=_STEP_M, camera_height_m=plan.camera_height_m)
    grid.binned(plan)
    return grid


def _time_of(work: Callable[[], _T]) -> tuple[float, _T]:
    begin = time.process_time()
    done = work()
    return time.process_time() - begin, done


if __name__ == "__main__":
    main()
