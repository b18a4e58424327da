"""Places that look alike share the probability equally: copies of a flat, equal offices, headings of a room.

The pictures are perfect: the true wall profile with a moderate uncertainty, so that only the plan decides.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.optimise import PoseRefiner
from lalaloc_core.localise.pipeline import Localisation, localise
from lalaloc_core.localise.poses import PredictedProfile, Query
from lalaloc_core.localise.ranking import panorama_heading
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import crooked_flat, plan_of, rectangle

CAMERA_M = 1.5
LOG_SCALE = -3.5
# Not a multiple of the grid's step, so that the lattice lies differently in every copy.
APART_M = 0.17
COPIES = [2, 4, 8]


def copied(polygons: list[Any], count: int) -> FloorPlan:
    """Return a plan of copies of some rooms in a row."""
    step_m = float(np.ptp(np.concatenate(polygons)[:, 0])) + 1.0 + APART_M
    shift = [np.array([k * step_m, 0.13 * k]) for k in range(count)]
    return plan_of(*((np.array(polygon) + by).tolist() for by in shift for polygon in polygons))


def localised(
    encoders: Encoders,
    optimiser: PoseRefiner,
    plan: FloorPlan,
    place_m: tuple[float, float],
    *,
    known: bool,
    noise: float = 0.0,
    seed: int = 0,
) -> Localisation:
    """Localise a perfect picture of a place, with some noise of the encoders' outputs."""
    position = np.array([place_m], dtype=float)
    rolls = np.zeros(1) if known else np.arange(64) * (TWO_PI / 64)
    poses = PoseSet(position.repeat(len(rolls), axis=0), plan.room_index_at(position).repeat(len(rolls)))
    assert (poses.room_index >= 0).all()
    latents, profile_m = encoders.poses(plan, poses, -rolls, CAMERA_M)
    log_m = np.log(profile_m) + noise * np.random.default_rng(seed).normal(size=profile_m.shape).astype(np.float32)
    profile = PredictedProfile(log_m, np.full_like(profile_m, LOG_SCALE))
    query = Query(latents, rolls, 0.0, heading_known=known, camera_height=CameraHeight(CAMERA_M), profile=profile)
    grid = build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)
    return localise(plan, grid, encoders, query, refiner=optimiser.refine, top_k=10)


@pytest.mark.parametrize("known", [True, False], ids=["heading known", "heading searched"])
@pytest.mark.parametrize("count", COPIES)
class TestShares:
    @pytest.mark.parametrize("place_m", [(1.37, 1.12), (5.1, 1.3)])
    def test_copies_of_a_flat_share_the_probability(
        self, encoders: Encoders, optimiser: PoseRefiner, count: int, known: bool, place_m: tuple[float, float]
    ) -> None:
        plan = copied([room.polygon_m for room in crooked_flat().rooms], count)
        found = localised(encoders, optimiser, plan, place_m, known=known)
        assert found.posterior.position <= 1.0 / count + 0.05
        assert found.posterior.position >= 0.6 / count

    @pytest.mark.parametrize("width_m", [0.9, 1.15, 1.6, 2.9])
    def test_equal_offices_share_the_probability(
        self, encoders: Encoders, optimiser: PoseRefiner, count: int, known: bool, width_m: float
    ) -> None:
        plan = copied([np.array(rectangle(width_m, 4.1))], count)
        found = localised(encoders, optimiser, plan, (0.4 * width_m, 1.3), known=known)
        assert found.posterior.position <= 1.0 / count + 0.05


class TestHeadings:
    @pytest.mark.parametrize(("depth_m", "ways"), [(4.6, 2), (3.2, 4)], ids=["rectangle", "square"])
    @pytest.mark.parametrize("place_m", [(0.9, 1.1), (1.6, 0.0)], ids=["corner", "middle"])
    @pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-5])
    def test_symmetric_room_is_split_between_its_headings(
        self,
        encoders: Encoders,
        optimiser: PoseRefiner,
        depth_m: float,
        ways: int,
        place_m: tuple[float, float],
        noise: float,
    ) -> None:
        middle = place_m[1] == 0.0
        plan, place_m = plan_of(rectangle(3.2, depth_m)), (1.6, 0.5 * depth_m) if middle else place_m
        found = localised(encoders, optimiser, plan, place_m, known=False, noise=noise)
        headings = [panorama_heading(found.query, candidate) for candidate in found.candidates[:ways]]
        step = TWO_PI / ways
        turns = sorted(round(heading / step) % ways for heading in headings)
        assert turns == list(range(ways)), [math.degrees(heading) for heading in headings]
        assert found.posterior.candidate[:ways] == pytest.approx([1.0 / ways] * ways, abs=1e-3)
        assert found.posterior.heading <= 1.0 / ways + 0.05
        # In the middle of the room, all headings are at one place.
        assert found.posterior.position == pytest.approx(1.0 if middle else 1.0 / ways, abs=1e-3)

    def test_first_of_equal_places_does_not_depend_on_rounding(
        self, encoders: Encoders, optimiser: PoseRefiner
    ) -> None:
        plan = plan_of(rectangle(3.2, 3.2))
        first = localised(encoders, optimiser, plan, (0.9, 1.1), known=False).candidates[0]
        for seed in range(3):
            noisy = localised(encoders, optimiser, plan, (0.9, 1.1), known=False, noise=1e-6, seed=seed).candidates[0]
            assert noisy.position_m == pytest.approx(first.position_m, abs=1e-3)
            assert noisy.hypothesis == first.hypothesis


def test_corridor_is_determined_across_but_not_along(encoders: Encoders, optimiser: PoseRefiner) -> None:
    # The ends are visible at a few azimuths only.
    plan = plan_of(rectangle(60.0, 1.8))
    position = np.array([[30.0, 0.8]])
    _, profile_m = encoders.poses(plan, PoseSet(position, np.array([0])), np.zeros(1), CAMERA_M)
    # The prediction is uncertain beyond 6 m, as in a photograph of a plain corridor.
    far = profile_m > 6.0
    profile = PredictedProfile(np.log(np.minimum(profile_m, 9.0)), np.where(far, 3.0, LOG_SCALE))
    latents = np.eye(1, encoders.manifest.latent_size)
    query = Query(latents, np.zeros(1), 0.0, heading_known=True, camera_height=CameraHeight(CAMERA_M), profile=profile)
    grid = build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)
    found = localise(plan, grid, encoders, query, refiner=optimiser.refine)
    assert found.posterior.position < 0.2
    information = found.candidates[0].information
    assert information is not None
    assert information[0, 0] < 1e-3 * information[1, 1]
