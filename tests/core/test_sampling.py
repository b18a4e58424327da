"""Camera poses: the pose grid, random poses and training triplets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sampling import (
    WALL_MARGIN_M,
    PoseSet,
    TripletSampling,
    grid_size,
    pose_grid,
    random_poses,
    sample_neighbours,
    sample_triplets,
)
from tests.strategies import crooked_flat, plan_document, plan_of, plans, present, rectangle, room_polygons, seeds

BIG = plan_of(rectangle(8.0, 6.0), rectangle(6.0, 6.0, corner=(8.2, 0.0)))


def wall_distance(plan: FloorPlan, poses: PoseSet) -> np.ndarray:
    """Return the distance of each pose to the walls of its room, negative outside."""
    rooms = np.array([room.shape for room in plan.rooms], dtype=object)[poses.room_index]
    points = shapely.points(poses.position_m)
    sign = np.where(shapely.contains(rooms, points), 1.0, -1.0)
    return sign * shapely.distance(shapely.boundary(rooms), points)


@pytest.mark.parametrize("sample", [random_poses, sample_triplets, sample_neighbours])
def test_seed_determines_the_poses(sample: Callable[..., Any]) -> None:
    arguments = {
        random_poses: (BIG, 20),
        sample_triplets: (BIG, 4, TripletSampling()),
        sample_neighbours: (BIG, random_poses(BIG, 1, np.random.default_rng(0)), TripletSampling()),
    }[sample]
    first, again = (sample(*arguments, np.random.default_rng(7)) for _ in range(2))
    if sample is sample_triplets:
        (first, rows), (again, rows_again) = first, again
        np.testing.assert_array_equal(rows, rows_again)
    np.testing.assert_array_equal(first.position_m, again.position_m)
    np.testing.assert_array_equal(first.room_index, again.room_index)


class TestGrid:
    @given(plans(), st.floats(0.2, 1.5))
    def test_grid_covers_every_room(self, plan: FloorPlan, step_m: float) -> None:
        poses = pose_grid(plan, step_m)
        assert (wall_distance(plan, poses) > 0.0).all()
        assert set(poses.room_index) == set(range(len(plan.rooms)))

    @given(room_polygons(offset_m=3.0), st.sampled_from([0.25, 0.5, 1.0]))
    def test_grid_is_the_lattice_within_the_margin(self, polygon: list, step_m: float) -> None:
        plan = plan_of(polygon)
        room = plan.rooms[0].shape
        index = np.arange(-60, 61)
        lattice = np.stack(np.meshgrid(index, index), axis=-1).reshape(-1, 2)
        points = shapely.points(lattice * step_m)
        clearance = np.where(shapely.contains(room, points), shapely.distance(room.exterior, points), 0.0)
        poses = pose_grid(plan, step_m).position_m
        found = {tuple(pair) for pair in np.round(poses / step_m).astype(int)}
        # The eroded room's rounded corners have finitely many segments, so points at the margin are ambiguous.
        must = {tuple(pair) for pair in lattice[clearance > 1.02 * WALL_MARGIN_M]}
        may = {tuple(pair) for pair in lattice[clearance >= 0.999 * WALL_MARGIN_M]}
        if must:
            assert must <= found <= may
            np.testing.assert_allclose(poses / step_m, np.round(poses / step_m), atol=1e-9)
        assert len(found) == len(poses)

    @pytest.mark.parametrize(
        "polygon", [rectangle(0.5, 0.5, corner=(0.1, 0.1)), rectangle(0.25, 8.0, corner=(0.1, 0.1))]
    )
    def test_tiny_room_gets_one_interior_pose(self, polygon: list) -> None:
        plan = plan_of(rectangle(3.0, 3.0, corner=(10.0, 0.0)), polygon)
        poses = pose_grid(plan, 1.0)
        assert (poses.room_index == 1).sum() == 1
        assert wall_distance(plan, poses)[poses.room_index == 1] >= 0.1

    def test_neighbouring_rooms_share_a_lattice(self) -> None:
        together = pose_grid(plan_of(rectangle(3.0, 3.0), rectangle(3.0, 3.0, corner=(3.1, 0.0))), 0.5).position_m
        np.testing.assert_allclose(together / 0.5, np.round(together / 0.5))

    @pytest.mark.parametrize("step_m", [0.0, -0.5, float("nan")])
    def test_non_positive_step_is_refused(self, step_m: float) -> None:
        with pytest.raises(InvalidInputError, match="positive"):
            pose_grid(BIG, step_m)

    @given(plans())
    def test_size_estimate_has_the_right_order(self, plan: FloorPlan) -> None:
        exact = len(pose_grid(plan, 0.5))
        assert exact / 2 <= grid_size(plan, 0.5) <= 4 * exact + 20


class TestRandomPoses:
    @given(plans(), seeds(), st.integers(0, 40))
    def test_poses_keep_the_margin_to_walls(self, plan: FloorPlan, seed: int, count: int) -> None:
        poses = random_poses(plan, count, np.random.default_rng(seed), 0.15)
        assert len(poses) == len(poses.room_index) == count
        # Shapely approximates the rounded corners of the eroded room by segments.
        assert (wall_distance(plan, poses) > 0.98 * 0.15).all()

    def test_poses_are_uniform_over_the_floor(self) -> None:
        margin = 0.1
        plan = plan_of(rectangle(4.2, 2.2), rectangle(2.2, 2.2, corner=(6.0, 0.0)))
        count = 6000
        poses = random_poses(plan, count, np.random.default_rng(0), margin)
        # The first room splits into two squares of 2 m, the second is one: a third of the poses each.
        cell = np.where(poses.room_index == 1, 2, (poses.position_m[:, 0] > 2.1).astype(int))
        quarter = (poses.position_m[:, 1] > 1.1).astype(int)
        counts = np.bincount(2 * cell + quarter, minlength=6)
        # Six equal cells; 4.5 standard deviations.
        np.testing.assert_allclose(counts, count / 6, atol=4.5 * np.sqrt(count / 6))
        # The order is random: a prefix is a sample.
        assert 0.2 < (poses.room_index[:300] == 1).mean() < 0.47

    def test_room_narrower_than_the_margin_has_no_poses_and_such_a_plan_is_refused(self) -> None:
        plan = plan_of(rectangle(3.0, 3.0), rectangle(0.25, 3.0, corner=(4.0, 0.0)))
        assert set(random_poses(plan, 200, np.random.default_rng(0), 0.15).room_index) == {0}
        with pytest.raises(InvalidInputError, match=r"0\.15 m"):
            random_poses(plan_of(rectangle(0.25, 3.0)), 5, np.random.default_rng(0), 0.15)


class TestTriplets:
    @given(seeds(), st.integers(1, 4), st.integers(1, 6), st.integers(1, 20))
    def test_positives_are_near_and_negatives_far(
        self, seed: int, anchors: int, positives: int, negatives: int
    ) -> None:
        sampling = TripletSampling(positives=positives, negatives=negatives)
        poses, rows = present(sample_triplets(BIG, anchors, sampling, np.random.default_rng(seed)))
        assert rows.shape == (anchors, 1 + positives + negatives)
        distance = np.linalg.norm(poses.position_m[rows] - poses.position_m[rows[:, :1]], axis=-1)
        assert (distance[:, 1 : 1 + positives] < sampling.positive_radius_m).all()
        assert (distance[:, 1 + positives :] > sampling.negative_radius_m).all()
        assert len(set(rows[:, 0])) == anchors
        for row in rows:
            assert len(set(row)) == len(row), "a neighbour was drawn twice"

    @given(seeds())
    def test_poses_are_in_their_rooms(self, seed: int) -> None:
        plan = crooked_flat()
        drawn = sample_triplets(plan, 3, TripletSampling(positives=6, negatives=4), np.random.default_rng(seed))
        assert drawn is not None
        assert (wall_distance(plan, drawn[0]) > 0.0).all()


class TestNeighbours:
    @given(seeds(), st.integers(0, 6), st.integers(1, 20))
    def test_neighbours_of_a_pose_are_near_or_far(self, seed: int, positives: int, negatives: int) -> None:
        rng = np.random.default_rng(seed)
        sampling = TripletSampling(positives=positives, negatives=negatives)
        anchor = random_poses(BIG, 1, rng)
        poses = present(sample_neighbours(BIG, anchor, sampling, rng))
        assert len(poses) == len(poses.room_index) == positives + negatives
        distance = np.linalg.norm(poses.position_m - anchor.position_m, axis=1)
        assert (distance[:positives] < sampling.positive_radius_m).all()
        assert (distance[positives:] > sampling.negative_radius_m).all()
        assert (wall_distance(BIG, poses) > 0.0).all()

    def test_plan_without_far_poses_gives_none(self) -> None:
        plan = plan_of(rectangle(1.5, 1.2))
        anchor = random_poses(plan, 1, np.random.default_rng(0))
        assert sample_neighbours(plan, anchor, TripletSampling(), np.random.default_rng(0)) is None
        assert sample_triplets(plan, 1, TripletSampling(), np.random.default_rng(0)) is None

    @given(seeds())
    def test_low_rooms_are_excluded(self, seed: int) -> None:
        large = [rectangle(6.0, 6.0, corner=(3.1, y_m)) for y_m in (0.0, 6.1)]
        document = plan_document(rectangle(3.0, 3.0), *large)
        document["rooms"][1]["ceiling_height_m"] = 2.0
        plan, rng = FloorPlan.from_dict(document), np.random.default_rng(seed)
        # The anchor is at the wall to the low room, so positives are drawn there as well.
        anchor = PoseSet(np.array([[2.9, 1.0]]), np.array([0]))
        poses = sample_neighbours(plan, anchor, TripletSampling(positives=8, negatives=4), rng, lowest_ceiling_m=2.2)
        assert poses is not None
        assert set(poses.room_index[:8]) == {0}
        assert set(poses.room_index[8:]) <= {0, 2}

    def test_pose_in_a_low_room_is_its_own_neighbour(self) -> None:
        document = plan_document(rectangle(8.0, 8.0), rectangle(8.0, 8.0, corner=(0.5, 0.0)))
        document["rooms"][0]["ceiling_height_m"] = 2.0
        plan = FloorPlan.from_dict(document)
        anchor = PoseSet(np.array([[4.0, 4.0]]), np.array([1]))
        poses = sample_neighbours(
            plan, anchor, TripletSampling(positives=2, negatives=4), np.random.default_rng(0), lowest_ceiling_m=2.2
        )
        assert poses is not None
        assert set(poses.room_index) == {1}
