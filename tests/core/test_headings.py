"""End-to-end tests of heading signs in the renderer, the encoders and the search.

The image encoder is perfect: it reads the wall profile from the pixels of a painted sphere. An error in an answer
is therefore a wrong sign or an off-by-one between renderer, roll and search.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.learn.training.config import PRESETS
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.localise.search.pipeline import localise
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet
from tests.core.questions import paint
from tests.core.test_optimise import smooth_encoder
from tests.strategies import crooked_flat, present

RING = PRESETS["tiny"].ring
COLUMNS, SECTORS = RING.profile_columns, RING.sectors
SECTOR = TWO_PI / SECTORS
CAMERA_M = 1.5

headings = st.floats(-math.pi, 2.0 * math.pi)


FLAT = crooked_flat()
POSE = PoseSet(np.array([[1.37, 1.12]]), np.array([0]))


def photograph_of(pose: PoseSet, heading: float) -> np.ndarray:
    walls = FLAT.walls_m[pose.room_index]
    return paint(wall_profile(pose.position_m, np.array([heading]), walls, COLUMNS)[0])


def assert_found(
    encoders: PhotographEncoder, optimiser: PoseRefiner, query: Query, pose: PoseSet, heading: float
) -> None:
    """Check that a search with a query finds a pose and the heading of the photograph."""
    grid = build_grid(FLAT, encoders.layouts, step_m=0.25, camera_height_m=CAMERA_M)
    best = localise(FLAT, grid, encoders.layouts, query, refiner=optimiser.refine).candidates[0]
    assert best.room_index == pose.room_index[0]
    assert np.hypot(*(best.position_m - pose.position_m[0])) < 0.02
    assert abs(wrap_angle(photograph_heading(query, best) - heading)) < math.radians(1.0)
    assert -math.pi <= photograph_heading(query, best) <= math.pi


class TestRolls:
    def test_layout_ring_rolls_with_the_profile(self) -> None:
        profile = torch.empty(3, 128).uniform_(0.5, 6.0, generator=torch.Generator().manual_seed(0))
        heights = (torch.full((3,), 1.5), torch.full((3,), 2.5))
        ring = smooth_encoder().ring(profile, *heights)
        for sectors in (1, 5, 63):
            rolled = smooth_encoder().ring(profile.roll(2 * sectors, dims=1), *heights)
            torch.testing.assert_close(rolled, ring.roll(sectors, dims=2), atol=1e-5, rtol=1e-4)

    def test_image_ring_and_profile_roll_with_the_sphere(self) -> None:
        torch.manual_seed(0)
        encoder = RingImageEncoder(RING).eval().requires_grad_(False)
        image = torch.randint(0, 256, (2, RING.image_height, RING.image_width, 3))
        height = torch.tensor([1.2, 1.7])
        still = encoder(image, height)
        pixels = RING.image_width // SECTORS
        for sectors in (1, 7, SECTORS - 1):
            turned = encoder(image.roll(pixels * sectors, dims=2), height)
            torch.testing.assert_close(turned.ring, still.ring.roll(sectors, dims=2), atol=1e-4, rtol=1e-3)
            for name in ("log_profile", "log_scale"):
                expected = getattr(still.walls, name).roll(COLUMNS // SECTORS * sectors, dims=1)
                torch.testing.assert_close(getattr(turned.walls, name), expected, atol=1e-4, rtol=1e-3)


class TestRealEncoders:
    """Relations of the exported networks that hold for any weights."""

    @given(st.integers(0, SECTORS - 1))
    @settings(max_examples=SECTORS)
    def test_true_hypothesis_has_the_latent_of_heading_zero(self, encoders: PhotographEncoder, sector: int) -> None:
        rng = np.random.default_rng(sector)
        at_zero = rng.integers(0, 256, (RING.image_height, RING.image_width, 3), dtype=np.uint8)
        # Turning the camera to the right rolls the sphere to the left.
        turned = np.roll(at_zero, -sector * RING.image_width // SECTORS, axis=1)
        straight = encoders.spheres.query(at_zero, 0.0, CameraHeight(CAMERA_M))
        unknown = encoders.spheres.query(turned, None, CameraHeight(CAMERA_M))
        assert len(unknown.latents) == len(unknown.roll) == SECTORS
        hypothesis = int(np.abs(wrap_angle(unknown.roll - sector * SECTOR)).argmin())
        assert abs(wrap_angle(unknown.roll[hypothesis] - sector * SECTOR)) < 1e-9
        np.testing.assert_allclose(unknown.latents[hypothesis], straight.latents[0], atol=1e-4)
        known = encoders.spheres.query(turned, sector * SECTOR, CameraHeight(CAMERA_M))
        np.testing.assert_allclose(known.latents[0], straight.latents[0], atol=1e-4)
        assert abs(known.frame_heading) < 1e-9

    @given(headings)
    def test_roll_and_frame_heading_add_up_to_a_known_heading(
        self, encoders: PhotographEncoder, heading: float
    ) -> None:
        image = np.zeros((RING.image_height, RING.image_width, 3), np.uint8)
        query = encoders.spheres.query(image, heading, CameraHeight(CAMERA_M))
        assert query.heading_known
        assert abs(wrap_angle(query.roll[0] + query.frame_heading - heading)) < 1e-9
        assert abs(query.frame_heading) <= math.pi / RING.image_width + 1e-9


class TestPerfectEncoder:
    @pytest.mark.parametrize("known", [True, False])
    @given(headings)
    @settings(max_examples=30)
    def test_nearest_hypothesis_has_the_latent_of_the_layout(
        self, perfect: PhotographEncoder, known: bool, heading: float
    ) -> None:
        image = photograph_of(POSE, heading)
        query = perfect.spheres.query(image, heading if known else None, CameraHeight(CAMERA_M))
        rest = wrap_angle(heading - query.roll)
        nearest = int(np.abs(rest).argmin())
        assert abs(rest[nearest]) <= SECTOR / 2 + 1e-9
        layout, profile_m = perfect.layouts.poses(FLAT, POSE, rest[nearest : nearest + 1], CAMERA_M)
        np.testing.assert_allclose(query.latents[nearest], layout[0], atol=2e-3)
        np.testing.assert_allclose(np.exp(present(query.profile).log_m[nearest]), profile_m[0], atol=2e-4)

    @pytest.mark.slow
    @given(heading=headings, share=st.floats(-1.0, 1.0), tolerance=st.floats(0.01, math.pi / 4.0))
    @settings(max_examples=30)
    def test_inexact_heading_is_searched_within_its_tolerance(
        self, perfect: PhotographEncoder, optimiser: PoseRefiner, heading: float, share: float, tolerance: float
    ) -> None:
        image, stated = photograph_of(POSE, heading), heading + share * tolerance
        query = perfect.spheres.query(image, stated, CameraHeight(CAMERA_M), heading_tolerance=tolerance)
        assert not query.heading_known
        turned = wrap_angle(query.roll + query.frame_heading - stated)
        assert tolerance <= np.abs(turned).max() < tolerance + SECTOR
        assert np.abs(np.diff(np.sort(np.asarray(turned, dtype=float))) - SECTOR).max(initial=0.0) < 1e-9
        assert_found(perfect, optimiser, query, POSE, heading)

    @given(heading=headings, known=st.booleans(), place=st.integers(0, 5))
    @settings(max_examples=24)
    def test_search_finds_the_pose_and_the_heading(
        self, perfect: PhotographEncoder, optimiser: PoseRefiner, heading: float, known: bool, place: int
    ) -> None:
        position = np.array([[1.37, 1.12], [3.21, 1.63], [0.81, 2.35], [5.12, 0.86], [4.23, 5.04], [1.66, 4.71]][place])
        pose = PoseSet(position[None], FLAT.room_index_at(position[None]))
        image = photograph_of(pose, heading)
        query = perfect.spheres.query(image, heading if known else None, CameraHeight(CAMERA_M))
        assert_found(perfect, optimiser, query, pose, heading)
