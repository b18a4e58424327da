"""Robots and AR devices: the base in the map, `map -> odom`, and a device's world aligned with the plan."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lalaloc_client.alignment import align, plan_point
from lalaloc_client.frames import Convention, Matrix, camera_matrix, ros_pose
from lalaloc_client.model import Position
from lalaloc_client.planar import (
    FloorTransform,
    base_covariance,
    map_from_base,
    map_from_odom,
    motion_between,
    of_answer,
    of_ros,
)
from lalaloc_client.tracking import TrackedPose

RNG = np.random.default_rng(49)
COVARIANCE = ((0.04, 0.01, 0.3), (0.01, 0.09, -0.2), (0.3, -0.2, 9.0))


def tracked(x: float, y: float, heading_deg: float) -> TrackedPose:
    return TrackedPose(
        number=1,
        position=Position(x, y),
        heading_deg=heading_deg,
        room="",
        room_id="",
        covariance=COVARIANCE,
        probability=1.0,
        camera_height_m=1.5,
        candidates=(),
        motion_contradicted=(),
        warnings=(),
        timings_ms={},
    )


def random_transform() -> FloorTransform:
    x, y, yaw = RNG.uniform(-3, 3, 3)
    return FloorTransform(x, y, yaw)


def homogeneous(pose: FloorTransform) -> np.ndarray:
    sine, cosine = math.sin(pose.yaw), math.cos(pose.yaw)
    return np.array([[cosine, -sine, pose.x_m], [sine, cosine, pose.y_m], [0, 0, 1]])


def same(one: FloorTransform, other: FloorTransform) -> bool:
    return np.allclose(homogeneous(one), homogeneous(other), atol=1e-9)


def test_transforms_compose_like_matrices() -> None:
    for _ in range(20):
        a, b = random_transform(), random_transform()
        np.testing.assert_allclose(homogeneous(a @ b), homogeneous(a) @ homogeneous(b), atol=1e-9)
        np.testing.assert_allclose(homogeneous(a.inverse()), np.linalg.inv(homogeneous(a)), atol=1e-9)
        x, y, z, w = a.orientation
        assert same(of_ros(a.x_m, a.y_m, (x, y, z, w)), a)


def test_base_of_a_robot_is_behind_its_camera() -> None:
    # The camera is 0.3 m ahead of the base and looks to its left; the photograph looks along the plan's +y.
    base = map_from_base(tracked(2.0, 5.0, 0.0), FloorTransform(0.3, 0.0, math.pi / 2))
    # So the base looks along +x, 0.3 m behind the camera.
    assert same(base, FloorTransform(1.7, 5.0, 0.0))


def test_map_to_odom_puts_odometry_at_the_answer() -> None:
    for _ in range(20):
        odom_from_base, mount = random_transform(), random_transform()
        x, y = RNG.uniform(0, 9, 2)
        pose = tracked(x, y, float(RNG.uniform(0, 360)))
        correction = map_from_odom(pose, mount, odom_from_base)
        assert same(correction @ odom_from_base @ mount, of_answer(pose))
        # A robot that then drives on by odometry is where it drove to.
        step = FloorTransform(1.0, 0.0, 0.2)
        assert same(correction @ (odom_from_base @ step), map_from_base(pose, mount) @ step)


def test_covariance_of_the_base_is_that_of_many_answers() -> None:
    mount = FloorTransform(0.8, -0.4, 0.7)
    mean = np.array([3.0, 4.0, 70.0])
    small = np.array(COVARIANCE) * 0.01
    drawn = RNG.multivariate_normal(mean, small, 20_000)
    bases = [map_from_base(tracked(*row), mount) for row in drawn]
    found = np.cov([[base.x_m, base.y_m, -math.degrees(base.yaw)] for base in bases], rowvar=False)
    stated = base_covariance(tuple(map(tuple, small)), tracked(*mean), mount)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(stated, found, atol=0.03 * float(small.max()), rtol=0.1)


def test_motion_is_that_of_the_camera() -> None:
    # A base that turns left on the spot swings a camera, which is ahead of it and looks ahead, forward to the left.
    moved = motion_between(FloorTransform(0, 0, 0), FloorTransform(0, 0, math.pi / 2), FloorTransform(1, 0, 0))
    assert (moved.forward_m, moved.right_m, moved.turn_deg) == pytest.approx((-1.0, -1.0, -90.0))
    mount, before = random_transform(), random_transform()
    ahead = before @ mount @ FloorTransform(2.0, 0.0, 0.0) @ mount.inverse()
    straight = motion_between(before, ahead, mount)
    assert (straight.forward_m, straight.right_m, straight.turn_deg) == pytest.approx((2.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(("quaternion", "words"), [((0, 0, 0, 0), "length 0"), ((1, 0, 0, 0), "tilted by 180°")])
def test_poses_that_are_not_on_the_floor_are_refused(quaternion: tuple, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        of_ros(0.0, 0.0, quaternion)


def device_world(convention: Convention) -> np.ndarray:
    """Return a world of a device: turned about its y axis and shifted, seen from the plan in its convention."""
    angle = float(RNG.uniform(-3, 3))
    sine, cosine = math.sin(angle), math.cos(angle)
    shift = RNG.uniform(-4, 4, 3)
    rows = [[cosine, 0, sine, shift[0]], [0, 1, 0, shift[1]], [-sine, 0, cosine, shift[2]], [0, 0, 0, 1]]
    return np.array(rows)


def rows_of(matrix: np.ndarray) -> Matrix:
    return tuple(tuple(float(value) for value in row) for row in matrix)


def tilted(pitch: float) -> np.ndarray:
    """Return a turn of a camera about its own x axis."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    return np.array([[1, 0, 0, 0], [0, cosine, -sine, 0], [0, sine, cosine, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("convention", ["opengl", "unity"])
def test_one_turn_aligns_a_device_exactly(convention: Convention) -> None:
    for _ in range(10):
        world = device_world(convention)
        poses = [tracked(3.0, 2.0, heading) for heading in RNG.uniform(0, 360, 12)]
        # Phones are tilted; only their direction on the floor counts.
        cameras = [
            rows_of(world @ np.array(camera_matrix(pose, convention)) @ tilted(RNG.uniform(-0.6, 0.6)))
            for pose in poses
        ]
        for count in (1, 12):
            found = align(poses[:count], cameras[:count], convention, camera_height_m=1.5)
            np.testing.assert_allclose(found.world_from_plan, world, atol=1e-9)
            assert (found.misfit_deg, found.misfit_m) == pytest.approx((0.0, 0.0), abs=1e-6)
        corner = world @ [*plan_point(3.0, 2.0, 1.5, convention), 1.0]
        np.testing.assert_allclose(corner[:3], np.array(cameras[0])[:3, 3], atol=1e-9)


def test_a_turn_averages_errors_and_states_the_misfit() -> None:
    world = device_world("opengl")
    headings = np.arange(12) * 30.0
    cameras = [rows_of(world @ np.array(camera_matrix(tracked(3.0, 2.0, h), "opengl"))) for h in headings]
    errors = RNG.normal(0.0, 3.0, 12)
    poses = [tracked(3.0, 2.0, (h + e) % 360) for h, e in zip(headings, errors, strict=True)]
    found = align(poses, cameras, "opengl", camera_height_m=1.5)
    turned = np.linalg.inv(world) @ np.array(found.world_from_plan)
    off_deg = abs(math.degrees(math.atan2(turned[0, 2], turned[0, 0])))
    assert off_deg == pytest.approx(abs(errors.mean()), abs=0.05)
    assert found.misfit_deg == pytest.approx(abs(errors - errors.mean()).max(), abs=0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda poses, cameras: (poses, cameras[:1]), "give one camera for each pose"),
        (lambda poses, cameras: (poses, cameras[::-1]), "in the same order"),
        (lambda poses, cameras: (poses, [rows_of(2.0 * np.array(c)) for c in cameras]), "stretches by 2"),
        (lambda poses, cameras: (poses, [rows_of(np.array(c) @ tilted(1.4)) for c in cameras]), "hold it upright"),
    ],
)
def test_photographs_that_do_not_fit_are_refused(change, words: str) -> None:
    poses = [tracked(3.0, 2.0, heading) for heading in (0.0, 90.0)]
    poses, cameras = change(poses, [camera_matrix(pose, "opengl") for pose in poses])
    with pytest.raises(ValueError, match=words):
        align(poses, cameras, "opengl", camera_height_m=1.5)


def test_answer_and_ros_pose_agree() -> None:
    pose = tracked(1.0, 2.0, 200.0)
    stated = ros_pose(pose)
    assert same(of_ros(*stated.position[:2], stated.orientation), of_answer(pose))
