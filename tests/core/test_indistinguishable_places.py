"""Places that cannot be told apart share what is probable: copies of a flat, equal offices, headings of a room.

The pictures are perfect (the true wall profile with a moderate uncertainty), so that nothing but the plan decides.
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
# No multiple of the grid's step, so that the lattice lies otherwise in every copy.
APART_M = 0.17
COPIES = [2, 4, 8]


def copied(polygons: list[Any], count: int) -> FloorPlan:
    """So many copies of some rooms in a row."""
    step_m = float(np.ptp(np.concatenate(polygons)[:, 0])) + 1.0 + APART_M
    shift = [np.array([k * step_m, 0.13 * k]) for k in range(count)]
    return plan_of(*((np.array(polygon) + by).tolist() for by in shift for polygon in polygons))


def found_at(
    encoders: Encoders, optimiser: PoseRefiner, plan: FloorPlan, at: tuple[float, float], *, known: bool
) -> Localisation:
    """The answer to a perfect picture of a place of the plan."""
    position = np.array([at], dtype=float)
    rolls = np.zeros(1) if known else np.arange(64) * (TWO_PI / 64)
    poses = PoseSet(position.repeat(len(rolls), axis=0), plan.room_index_at(position).repeat(len(rolls)))
    assert (poses.room_index >= 0).all()
    latents, profile_m = encoders.poses(plan, poses, -rolls, CAMERA_M)
    profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, LOG_SCALE))
    query = Query(latents, rolls, 0.0, heading_known=known, camera_height=CameraHeight(CAMERA_M), profile=profile)
    grid = build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)
    return localise(plan, grid, encoders, query, refiner=optimiser.refine, top_k=10)


@pytest.mark.parametrize("known", [True, False], ids=["heading known", "heading searched"])
@pytest.mark.parametrize("count", COPIES)
class TestShares:
    @pytest.mark.parametrize("at", [(1.37, 1.12), (5.1, 1.3)])
    def test_copies_of_a_flat_get_no_more_than_their_share(
        self, encoders: Encoders, optimiser: PoseRefiner, count: int, known: bool, at: tuple[float, float]
    ) -> None:
        plan = copied([room.polygon_m for room in crooked_flat().rooms], count)
        found = found_at(encoders, optimiser, plan, at, known=known)
        assert found.posterior.position <= 1.0 / count + 0.05
        # And the copies share all of it.
        assert found.posterior.position >= 0.6 / count

    @pytest.mark.parametrize("width_m", [0.9, 1.15, 1.6, 2.9])
    def test_nor_do_equal_offices_even_narrow_ones(
        self, encoders: Encoders, optimiser: PoseRefiner, count: int, known: bool, width_m: float
    ) -> None:
        plan = copied([np.array(rectangle(width_m, 4.1))], count)
        found = found_at(encoders, optimiser, plan, (0.4 * width_m, 1.3), known=known)
        assert found.posterior.position <= 1.0 / count + 0.05


class TestHeadings:
    @pytest.mark.parametrize(("depth_m", "ways"), [(4.6, 2), (3.2, 4)], ids=["rectangle", "square"])
    @pytest.mark.parametrize("at", [(0.9, 1.1), (1.6, 0.0)], ids=["in a corner", "in the middle"])
    def test_a_room_without_openings_is_split_between_its_headings(
        self, encoders: Encoders, optimiser: PoseRefiner, depth_m: float, ways: int, at: tuple[float, float]
    ) -> None:
        middle = at[1] == 0.0
        plan = plan_of(rectangle(3.2, depth_m))
        found = found_at(encoders, optimiser, plan, (1.6, 0.5 * depth_m) if middle else at, known=False)
        headings = [panorama_heading(found.query, one) for one in found.candidates[:ways]]
        step = TWO_PI / ways
        turns = sorted(round(heading / step) % ways for heading in headings)
        assert turns == list(range(ways)), [math.degrees(heading) for heading in headings]
        assert found.posterior.candidate[:ways] == pytest.approx([1.0 / ways] * ways, abs=0.05)
        assert found.posterior.heading <= 1.0 / ways + 0.05
        # Standing in the middle, all of them are at one place. Else the last bit decides which of the equals is first,
        # and where the grid's lattice happens to lie how much of the others is within a metre of it.
        assert found.posterior.position == pytest.approx(1.0 if middle else 1.0 / ways, abs=0.1)


def test_a_corridor_is_known_across_and_not_along(encoders: Encoders, optimiser: PoseRefiner) -> None:
    # Longer than the picture tells: its ends are seen at a few azimuths alone.
    plan = plan_of(rectangle(60.0, 1.8))
    position = np.array([[30.0, 0.8]])
    _, profile_m = encoders.poses(plan, PoseSet(position, np.array([0])), np.zeros(1), CAMERA_M)
    # Beyond 6 m nothing is read with any certainty, as in a photograph of a plain corridor.
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
