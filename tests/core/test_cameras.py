"""Camera models against OpenCV, and from rays to pixels and back."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.photograph.cameras import Around, Camera, Fisheye, Perspective

_IDEAL = Perspective(width=640, height=480, fx=500.0, fy=510.0, cx=300.0, cy=250.0)
DISTORTED = replace(_IDEAL, radial=(-0.28, 0.09, -0.01), tangential=(0.002, -0.001))
FISHEYE = Fisheye(width=640, height=480, fx=200.0, fy=205.0, cx=310.0, cy=245.0, radial=(0.03, -0.01, 0.002, -0.0001))
CAMERAS: list[Camera] = [
    Perspective.of_hfov(640, 480, math.radians(70.0)),
    DISTORTED,
    FISHEYE,
    Fisheye.of_hfov(640, 480, math.radians(150.0)),
    Around(width=900, height=300, hfov=math.radians(200.0)),
    Around(width=900, height=300, hfov=math.radians(200.0), elevation=0.1),
    Around(width=1024, height=512, hfov=2.0 * math.pi, spherical=True),
]


def opencv_points(rays: np.ndarray) -> np.ndarray:
    """Return rays in OpenCV's frame (right, down, forward)."""
    return np.stack([rays[:, 0], -rays[:, 2], rays[:, 1]], axis=-1)[:, None]


def matrix(camera: Perspective | Fisheye) -> np.ndarray:
    """Return the camera matrix by OpenCV's count of pixels."""
    return np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: type(camera).__name__)
@given(across=st.floats(0.0, 1.0), down=st.floats(0.01, 0.99))
def test_pixels_undo_rays(camera: Camera, across: float, down: float) -> None:
    pixel = np.array([[across * camera.width, down * camera.height]])
    rays = camera.rays(pixel)
    assert np.linalg.norm(rays) == pytest.approx(1.0)
    again, seen = camera.pixels(3.0 * rays)
    # The seam of a full turn is on both sides.
    error = np.abs(again - pixel)
    error[:, 0] = np.minimum(error[:, 0], np.abs(camera.width - error[:, 0])) if camera.hfov > 6.0 else error[:, 0]
    assert error.max() < 1e-4
    if 0.001 < across < 0.999:
        assert seen.all()


def test_perspective_and_fisheye_agree_with_opencv() -> None:
    rays = DISTORTED.rays(np.random.default_rng(0).uniform([0.0, 0.0], [640.0, 480.0], (50, 2)))
    (k1, k2, k3), (p1, p2) = DISTORTED.radial, DISTORTED.tangential
    expected, _ = cv2.projectPoints(
        opencv_points(rays), np.zeros(3), np.zeros(3), matrix(DISTORTED), np.array([k1, k2, p1, p2, k3])
    )
    np.testing.assert_allclose(DISTORTED.pixels(rays)[0], expected[:, 0] + 0.5, atol=1e-6)
    rays = FISHEYE.rays(np.random.default_rng(0).uniform([0.0, 0.0], [640.0, 480.0], (50, 2)))
    rays = rays[rays[:, 1] > 0.1]
    expected, _ = cv2.fisheye.projectPoints(
        opencv_points(rays), np.zeros(3), np.zeros(3), matrix(FISHEYE), np.array(FISHEYE.radial)
    )
    assert len(rays) > 20
    np.testing.assert_allclose(FISHEYE.pixels(rays)[0], expected[:, 0] + 0.5, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: type(camera).__name__)
def test_scaled_camera_sees_the_same(camera: Camera) -> None:
    half = camera.scaled(camera.width // 2, camera.height // 2)
    rays = camera.rays(np.array([[100.0, 80.0], [500.0, 200.0]]))
    np.testing.assert_allclose(2.0 * half.pixels(rays)[0], camera.pixels(rays)[0], atol=1e-6)
    assert half.hfov == pytest.approx(camera.hfov)


def test_up_is_up_and_right_is_right() -> None:
    for camera in CAMERAS:
        centre, right, up = np.array([0.0, 1.0, 0.0]), np.array([0.1, 1.0, 0.0]), np.array([0.0, 1.0, 0.1])
        (x, y), (x_right, y_right), (x_up, y_up) = camera.pixels(np.stack([centre, right, up]))[0]
        assert x_right > x + 10.0
        assert y_right == pytest.approx(y, abs=2.0)
        assert y_up < y - 10.0
        assert x_up == pytest.approx(x, abs=2.0)


def test_rays_behind_and_beyond_the_picture_are_not_seen() -> None:
    camera = Perspective.of_hfov(640, 480, math.radians(90.0))
    rays = np.array([[0.0, -1.0, 0.0], [0.99, 1.0, 0.0], [1.01, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert camera.pixels(rays)[1].tolist() == [False, True, False, False]
    fisheye = Fisheye.of_hfov(500, 500, math.radians(200.0))
    angles = np.radians([99.0, 101.0])
    diagonal = np.stack([np.sin(angles) * 0.6, np.cos(angles), np.sin(angles) * 0.8], axis=-1)
    assert fisheye.pixels(diagonal)[1].tolist() == [True, False]


def test_rays_beyond_the_turning_point_of_a_distortion_are_not_seen() -> None:
    """A strong barrel distortion folds wide rays back into the picture."""
    camera = Perspective(width=640, height=480, fx=300.0, fy=300.0, cx=320.0, cy=240.0, radial=(-0.3, 0.0, 0.0))
    pixels, seen = camera.pixels(np.array([[1.6, 1.0, 0.0]]))
    assert 0.0 < pixels[0, 0] < 640.0 or not seen[0]
    assert not seen[0]


def test_cylinder_of_a_turn_has_straight_verticals() -> None:
    camera = Around(width=720, height=200, hfov=2.0 * math.pi)
    rays = np.array([[1.0, 0.0, height] for height in (-0.3, 0.0, 0.3)])
    np.testing.assert_allclose(camera.pixels(rays)[0][:, 0], 540.0)
