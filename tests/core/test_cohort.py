"""Tests of the cohort: poses of other homes that calibrate the cost of a fit."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.errors import BundleError
from lalaloc_core.evaluate.calibrate import store_cohort
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic import training_plans
from lalaloc_core.localise.bundle import COHORT, Bundle, MatchingWeights, write_manifest
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.cohort import SIZE, Cohort, cohort_of, cost_by_chance, log_cost_to_chance
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.optimise import PoseRefiner
from lalaloc_core.localise.pipeline import LocaliseConfig, localise
from lalaloc_core.localise.poses import PredictedProfile, Query
from lalaloc_core.localise.retrieval import build_grid, grid_costs
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import crooked_flat, plan_of, rectangle

CAMERA_M = 1.5
PLANS = training_plans(4, 0)


@pytest.fixture(scope="module")
def cohort(encoders: Encoders) -> Cohort:
    return cohort_of(PLANS, encoders.manifest.profile_columns, 0)


def query_at(encoders: Encoders, plan: FloorPlan, position_m: tuple[float, float], log_scale: float) -> Query:
    """Return a perfect prediction at a position, heading known."""
    position = np.array([position_m])
    poses = PoseSet(position, plan.room_index_at(position))
    latents, profile_m = encoders.poses(plan, poses, np.zeros(1), CAMERA_M)
    profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, log_scale))
    return Query(latents, np.zeros(1), 0.0, heading_known=True, camera_height=CameraHeight(CAMERA_M), profile=profile)


def log_cost_to_cohort(encoders: Encoders, cohort: Cohort | None, plan: FloorPlan, query: Query) -> float:
    weights, config = MatchingWeights(), MatchingConfig()
    grid = build_grid(plan, encoders, step_m=0.5, camera_height_m=CAMERA_M)
    cost = float(grid_costs(plan, grid, query, weights, config).cost.min())
    expected = cost_by_chance(cohort, plan, query, config.grid_reach * 0.5, weights, config)
    return log_cost_to_chance(cost, expected)


@pytest.mark.parametrize("log_scale", [-3.5, -2.0], ids=["clear", "dim"])
def test_only_the_own_home_fits_better_than_the_cohort(encoders: Encoders, cohort: Cohort, log_scale: float) -> None:
    home, hall = crooked_flat(), plan_of(rectangle(14.0, 11.0))
    query = query_at(encoders, home, (5.1, 1.3), log_scale)
    assert log_cost_to_cohort(encoders, cohort, home, query) < -0.5
    assert log_cost_to_cohort(encoders, cohort, hall, query) > 0.5


def test_signal_is_zero_without_cohort_or_profile(encoders: Encoders, cohort: Cohort) -> None:
    home = crooked_flat()
    query = query_at(encoders, home, (5.1, 1.3), -3.5)
    assert log_cost_to_cohort(encoders, None, home, query) == 0.0
    assert log_cost_to_cohort(encoders, cohort, home, replace(query, profile=None)) == 0.0


def test_cohort_has_a_fixed_size_and_is_reproducible(cohort: Cohort, encoders: Encoders) -> None:
    columns = encoders.manifest.profile_columns
    assert cohort.log_profile.shape == cohort.kind.shape == (min(SIZE, len(cohort.kind)), columns)
    assert len(cohort.kind) > 500
    assert set(np.unique(cohort.kind)) > {0, 1}
    again = cohort_of(PLANS, columns, 0)
    np.testing.assert_array_equal(again.log_profile, cohort.log_profile)


class TestBundles:
    @pytest.fixture
    def with_cohort(self, opened_bundle: Bundle, cohort: Cohort, tmp_path: Path) -> Bundle:
        folder = tmp_path / "bundle"
        shutil.copytree(opened_bundle.folder, folder)
        return store_cohort(Bundle.open(folder), cohort)

    def test_cohort_is_stored_and_gives_signals(
        self, with_cohort: Bundle, cohort: Cohort, optimiser: PoseRefiner
    ) -> None:
        found = Cohort.of_bundle(Bundle.open(with_cohort.folder))
        assert found is not None
        np.testing.assert_array_equal(found.kind, cohort.kind)
        encoders, home = Encoders(with_cohort, threads=1), crooked_flat()
        query = query_at(encoders, home, (5.1, 1.3), -3.5)
        grid = build_grid(home, encoders, step_m=0.5, camera_height_m=CAMERA_M)
        config = LocaliseConfig(every_stage=True)
        signals = localise(home, grid, encoders, query, refiner=optimiser.refine, config=config).signals
        expected = log_cost_to_cohort(encoders, cohort, home, query)
        assert len(signals) == 3
        for signal in signals.values():
            assert signal.cost_to_chance == pytest.approx(expected, abs=0.05)
        # The position lies between grid poses, so only refinement reaches the minimum.
        assert signals["retrieval"].answer_to_chance == pytest.approx(expected, abs=0.05)
        assert signals["lpo"].answer_to_chance < expected - 0.5

    def test_older_bundle_has_no_cohort(self, opened_bundle: Bundle) -> None:
        assert Cohort.of_bundle(opened_bundle) is None

    @pytest.mark.parametrize("damage", ["no arrays", "other columns"])
    def test_damaged_cohort_is_named(self, with_cohort: Bundle, cohort: Cohort, damage: str) -> None:
        narrow = Cohort(cohort.log_profile[:, :-1], cohort.kind[:, :-1]).to_bytes()
        (with_cohort.folder / COHORT).write_bytes(b"nothing" if damage == "no arrays" else narrow)
        changed = write_manifest(with_cohort.folder, with_cohort.manifest)
        with pytest.raises(BundleError, match=r"cohort\.npz"):
            Cohort.of_bundle(changed)
