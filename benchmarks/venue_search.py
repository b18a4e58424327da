"""How often a venue of some hundreds of plans is told right by the index and a full search of what it chose.

Generated homes stand in for real ones; queries are photographs of some of them. Each is answered twice by the
production search, with the optimiser: among the plans that the index of prototypes chose, as the service does, and
among all.

    .venv/bin/python -m benchmarks.venue_search --plans 400 --queries 24
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.venues import queries
from lalaloc_core.evaluate.methods.lalaloc import local_refiner
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS
from lalaloc_core.learn.synth.homes.splits import home_of
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.pipeline import localise
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from lalaloc_core.localise.venue.prototypes import most_probable, prototypes_of
from scripts.make_prototype_cells import grid_without_latents
from service.query.venue_localiser import VENUE_CONFIG
from service.query.venue_plans import MAX_SEARCHED, most_poses
from service.settings import Settings


def main() -> None:
    """Print shares of right plans, and times of the processor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    parser.add_argument("--plans", type=int, default=400)
    parser.add_argument("--queries", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    bundle, limit = Bundle.open(asked.bundle), Settings.load().grids.max_grid_poses
    encoders, refiner = Encoders(bundle, threads=1), local_refiner(bundle)
    homes = [home_of(SPLIT_NUMBERS["test"], asked.seed, number)[0] for number in range(asked.plans)]
    plans, grids = [home.plan for home in homes], [grid_without_latents(home) for home in homes]
    index = PlanIndex.of_parts(
        [prototypes_of(grid, plan) for grid, plan in zip(grids, plans, strict=True)], shipped_cells()
    )
    poses = np.array([len(grid.poses) for grid in grids])

    def found(query: Query, among: list[int]) -> int:
        laid = MergedPlans.of([plans[k] for k in among], [grids[k] for k in among], query.camera_height.height_m)
        answer = localise(laid.plan, laid.grid, encoders, query, refiner=refiner, config=VENUE_CONFIG)
        return among[laid.in_own_plan(answer.candidates[0])[0]]

    told = defaultdict(lambda: defaultdict(list))
    chosen = np.linspace(0, asked.plans - 1, asked.queries).astype(int).tolist()
    for number, name, query in queries(bundle, chosen, asked.seed):
        tally, begin = told[name], time.process_time()
        mass = index.log_masses(query, bundle.manifest.evidence, MatchingConfig())
        among = most_probable(mass, poses, most_plans=MAX_SEARCHED, most_poses=most_poses(query, limit)).tolist()
        indexed = time.process_time()
        by_index = found(query, among)
        searched = time.process_time()
        by_all = found(query, list(range(asked.plans)))
        tally["plans searched"].append(len(among))
        tally["right plan among them"].append(number in among)
        tally["right plan first by the index alone"].append(number == int(mass.argmax()))
        tally["right plan first by index and full search"].append(number == by_index)
        tally["right plan first by full search of all"].append(number == by_all)
        tally["the same first plan"].append(by_index == by_all)
        tally["s index, s full search, s of all"].append(
            [indexed - begin, searched - indexed, time.process_time() - searched]
        )
    for name, tally in told.items():
        print(f"{name}, n = {asked.queries}")
        for what, values in tally.items():
            print(f"  {what}: {np.round(np.mean(values, axis=0), 3)}")


if __name__ == "__main__":
    main()
