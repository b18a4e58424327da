"""Tests of the covariance of a pose from the information matrix of its refinement."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.floorplan import Room
from lalaloc_core.localise.bundle import ConfidenceModel
from lalaloc_core.localise.covariance import PoseUncertainty, marginal_information, pose_uncertainty
from tests.strategies import plan_of, rectangle, seeds

MODEL = ConfidenceModel(
    known_heading={}, searched_heading={}, position_factor=0.5, position_factor_searched=0.7, heading_factor=0.3
)
ROOM_STD_M = math.hypot(5.0, 4.0) / math.sqrt(12.0)
unknowns = st.sampled_from([2, 3])


@pytest.fixture(scope="module")
def room() -> Room:
    return plan_of(rectangle(5.0, 4.0)).rooms[0]


def information(seed: int, size: int, rank: int | None = None) -> np.ndarray:
    """Return a float32 information matrix of the given rank (full by default, at least 10 per m²)."""
    rows = np.random.default_rng(seed).normal(size=(size if rank is None else rank, size))
    matrix = rows.T @ rows + (np.eye(size) if rank is None else 0.0)
    return (10.0 * matrix).astype(np.float32)


def uncertainty_of(given: np.ndarray, room: Room, model: ConfidenceModel = MODEL) -> PoseUncertainty:
    found = pose_uncertainty(given, room, model)
    assert found is not None
    return found


class TestCovariance:
    @given(seed=seeds(), size=unknowns)
    def test_covariance_is_the_scaled_inverse(self, room: Room, seed: int, size: int) -> None:
        given = information(seed, size)
        inverse = np.linalg.inv(given.astype(float))
        found = uncertainty_of(given, room)
        factor = MODEL.position_factor if size == 2 else MODEL.position_factor_searched
        assert factor is not None
        np.testing.assert_allclose(found.position_m2, factor * inverse[:2, :2], rtol=1e-3, atol=1e-6)
        if size == 3:
            assert found.heading_std == pytest.approx(math.sqrt(0.3 * inverse[2, 2]), rel=1e-3)
        else:
            assert found.heading_std is None

    @given(seed=seeds(), size=unknowns, rank=st.integers(0, 3), scale=st.floats(1e-12, 1e12))
    def test_covariance_is_symmetric_positive_and_bounded(
        self, room: Room, seed: int, size: int, rank: int, scale: float
    ) -> None:
        found = uncertainty_of((scale * information(seed, size, min(rank, size))).astype(np.float32), room)
        np.testing.assert_array_equal(found.position_m2, found.position_m2.T)
        variance = np.linalg.eigvalsh(found.position_m2)
        assert variance.min() >= -1e-12 * variance.max()
        assert variance.max() <= ROOM_STD_M**2 * (1.0 + 1e-9)
        assert found.heading_std is None or 0.0 <= found.heading_std <= math.pi / math.sqrt(3.0)

    @given(seed=seeds(), size=unknowns, scale=st.floats(1.0, 100.0))
    def test_covariance_is_inverse_to_the_information(self, room: Room, seed: int, size: int, scale: float) -> None:
        wide, narrow = (
            uncertainty_of(information(seed, size), room),
            uncertainty_of(scale * information(seed, size), room),
        )
        np.testing.assert_allclose(narrow.position_m2 * scale, wide.position_m2, rtol=1e-3, atol=1e-6)

    def test_unobserved_direction_is_as_wide_as_the_room(self, room: Room) -> None:
        found = uncertainty_of(np.diag([0.0, 400.0]), room)
        np.testing.assert_allclose(found.position_m2, np.diag([ROOM_STD_M**2, 0.5 / 400.0]), atol=1e-12)

    def test_unobserved_heading_is_uniform(self, room: Room) -> None:
        found = uncertainty_of(np.diag([100.0, 100.0, 0.0]), room)
        np.testing.assert_allclose(found.position_m2, 0.007 * np.eye(2), atol=1e-12)
        assert found.heading_std == math.pi / math.sqrt(3.0)

    @pytest.mark.parametrize(
        ("size", "missing"), [(2, "position_factor"), (3, "position_factor_searched"), (3, "heading_factor")]
    )
    def test_model_without_the_factor_has_no_covariance(self, room: Room, size: int, missing: str) -> None:
        model = dataclasses.replace(MODEL, **{missing: None})
        assert pose_uncertainty(information(0, size), room, model) is None
        # The factor of the other size does not matter.
        assert pose_uncertainty(information(0, 5 - size), room, model) is not None


class TestMarginalInformation:
    @given(seed=seeds())
    def test_marginal_inverts_the_blocks_of_the_inverse(self, seed: int) -> None:
        given = information(seed, 3).astype(float)
        inverse = np.linalg.inv(given)
        by_position, by_heading = marginal_information(given)
        np.testing.assert_allclose(by_position, np.linalg.inv(inverse[:2, :2]), rtol=1e-6, atol=1e-6)
        assert by_heading == pytest.approx(1.0 / inverse[2, 2], rel=1e-4)
