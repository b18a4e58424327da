"""Accuracy in plans that miss openings, by what the plan states about them.

`python -m benchmarks.opening_trust` draws the openings of generated validation homes in whole, in half and not at all,
and searches them for furnished spheres with unknown heading. Plans state the exact openings, no kind, all kinds, the
trust that importers estimate, or the true share. `--venues` searches venues of ten homes instead, of which every second
one draws no openings.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import print_table_head, table_row
from lalaloc_core.bundle import Bundle
from lalaloc_core.evaluate.methods.lalaloc import StatedHeight, encode, read_image
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers.common.completeness import estimate_trust
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.venue.merged_plans import MergedPlans

_STATED_HEIGHT = StatedHeight()
_KINDS = ("door", "window", "passage")
_NEAR_M = 1.0
_SHARES = (1.0, 0.5, 0.0)
_RECALL = 0.95
_VENUE = 10


def plans_of(plan: FloorPlan, share: float, rng: np.random.Generator) -> dict[str, FloorPlan]:
    """Return a plan with a share of its openings, by what it states about them."""
    document = plan.to_dict()
    openings = [opening for opening in document.get("openings", []) if rng.random() < share]
    document |= {"openings": openings, "opening_kinds": []}
    estimated = {entry.kind: entry.trust for entry in estimate_trust(document, _RECALL)}
    stated: dict[str, dict[str, Any]] = {
        "no kind": {},
        "all kinds": {"opening_kinds": list(_KINDS)},
        "estimated trust": {"opening_trust": estimated},
        "true share": {"opening_trust": dict.fromkeys(_KINDS, share)},
    }
    return {name: FloorPlan.from_dict(document | claims) for name, claims in stated.items()}


def query_of(model: LocalModel, scene: Scene, camera: Camera, grid: Any) -> Query:
    """Return the query of a camera's photograph with an unknown heading."""
    question = Question(
        plan=scene.plan,
        grid=grid,
        grid_step_m=0.5,
        camera=camera,
        kind="panorama",
        photograph=scene.photograph(camera, GeneratedScenes(homes=1).appearances[0]),
        heading_known=False,
    )
    return encode(model.encoder, question, read_image(model.encoder, question), _STATED_HEIGHT)


def is_found(model: LocalModel, plan: FloorPlan, query: Query, camera: Camera) -> bool:
    """Return whether the best pose is within 1 m of the camera."""
    found = model.localise(plan, model.grid(plan, query.camera_height.height_m), query).candidates[0]
    return math.dist(found.position_m, camera.position_m) < _NEAR_M


def measure(model: LocalModel, scenes: GeneratedScenes) -> Mapping[tuple[float, str], list[bool]]:
    """Return by share and statement whether each photograph was found."""
    found: dict[tuple[float, str], list[bool]] = {}
    for index, name in enumerate(scenes.scenes("validation")):
        scene = scenes.load(name)
        variants = {(1.0, "exact"): scene.plan}
        for share in _SHARES:
            drawn = plans_of(scene.plan, share, np.random.default_rng(index))
            variants |= {(share, stated): plan for stated, plan in drawn.items()}
        for camera in scene.cameras:
            query = query_of(model, scene, camera, model.grid(scene.plan, camera.camera_height_m).poses)
            for key, plan in variants.items():
                found.setdefault(key, []).append(is_found(model, plan, query, camera))
    return found


def measure_venues(model: LocalModel, scenes: GeneratedScenes) -> dict[str, list[tuple[bool, bool]]]:
    """Return by kind of plan whether the plan and the place of each photograph were found in its venue."""
    loaded = [scenes.load(name) for name in scenes.scenes("validation")]
    found: dict[str, list[tuple[bool, bool]]] = {"all openings drawn": [], "none drawn": []}
    for begin in range(0, len(loaded), _VENUE):
        venue = loaded[begin : begin + _VENUE]
        bare = {"openings": [], "opening_kinds": []}
        plans = [
            FloorPlan.from_dict(scene.plan.to_dict() | (bare if number % 2 else {}))
            for number, scene in enumerate(venue)
        ]
        for number, scene in enumerate(venue):
            for camera in scene.cameras:
                query = query_of(model, scene, camera, model.grid(scene.plan, camera.camera_height_m).poses)
                height_m = query.camera_height.height_m
                merged = MergedPlans.of(plans, [model.grid(plan, height_m) for plan in plans], height_m)
                best = model.localise(merged.plan, merged.grid, query).candidates[0]
                plan, place = merged.in_own_plan(best)
                is_near = plan == number and math.dist(place.position_m, camera.position_m) < _NEAR_M
                found["none drawn" if number % 2 else "all openings drawn"].append((plan == number, is_near))
    return found


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--homes", type=int, default=40)
    parser.add_argument("--venues", action="store_true", help="search venues of ten homes")
    parser.add_argument("--bundle", type=Path, default=Path("models/default"))
    arguments = parser.parse_args()
    scenes = GeneratedScenes(homes=arguments.homes, shots_per_home=4)
    if arguments.venues:
        print_table_head("plan of the photograph", "n", "plan", "within 1 m")
        for stated, pairs in measure_venues(LocalModel(Bundle.open(arguments.bundle)), scenes).items():
            plan, near = 100.0 * np.mean(pairs, axis=0)
            print(table_row(stated, len(pairs), f"{plan:.1f} %", f"{near:.1f} %"))
        return
    found = measure(LocalModel(Bundle.open(arguments.bundle)), scenes)
    print_table_head("openings drawn", "stated", "n", "within 1 m")
    for (share, stated), hits in found.items():
        print(table_row(f"{100 * share:.0f} %", stated, len(hits), f"{100 * np.mean(hits):.1f} %"))


if __name__ == "__main__":
    main()
