"""Tracker, and the frames of robots and AR devices."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import httpx
import numpy as np
import pytest

from lalaloc_client import (
    AsyncClient,
    Client,
    Motion,
    NotFoundError,
    Position,
    TrackedPose,
    camera_matrix,
    heading_of,
    misfit_m,
    ros_pose,
    world_from_plan,
    yaw_of,
)

COVARIANCE = ((0.04, 0.01, 0.3), (0.01, 0.09, -0.2), (0.3, -0.2, 4.0))


def pose_at(heading_deg: float) -> TrackedPose:
    return TrackedPose(1, Position(2.0, 3.0), heading_deg, "hall", "hall", COVARIANCE, 0.9, 1.5, (), (), (), {})


def test_tracker_follows_a_camera_and_ends_its_session(app: httpx.Client, plan_id: str, sphere: bytes) -> None:
    with Client(str(app.base_url)) as service, service.track(plan_id, camera_height_m=1.5) as tracker:
        session_id = tracker.session.id
        first = tracker.add(sphere)
        second = tracker.add(sphere, Motion(forward_m=0.0, turn_deg=0.0), heading_deg=90.0, roll_deg=2.0)
        assert [first.photographs, second.photographs] == [1, 2]
        assert second.pose is not None
        assert second.pose.view is not None
        assert (second.pose.view.roll.value_deg, second.pose.view.roll.source) == (2.0, "given")
        assert [point.number for point in second.path] == [1, 2]
        # Another client counted a photograph whose answer this one did not get.
        with service.track(plan_id) as other:
            other.begin(session_id)
            third = other.add(sphere)
            assert tracker.add(sphere) == third
        with pytest.raises(NotFoundError):
            # `other` has ended the session.
            tracker.add(sphere)


def test_tracker_follows_a_camera_in_a_venue(app: httpx.Client, plan_id: str, sphere: bytes) -> None:
    venue = app.post("/venues", json={"plans": [{"floorplan_id": plan_id, "level": 2}]}).json()
    with Client(str(app.base_url)) as service, service.track(venue_id=venue["id"], level=2.0) as tracker:
        session = tracker.add(sphere)
        assert (session.venue_id, session.venue_revision) == (venue["id"], venue["revision"])
        assert session.pose is not None
        assert (session.pose.floorplan_id, session.pose.level) == (plan_id, 2.0)
        assert (session.path[0].floorplan_id, session.path[0].level) == (plan_id, 2.0)


def test_tracker_of_asyncio_follows_a_camera(app: httpx.Client, plan_id: str, sphere: bytes, tmp_path: Path) -> None:
    path = tmp_path / "photograph.jpg"
    path.write_bytes(sphere)

    async def follow() -> int:
        async with AsyncClient(str(app.base_url)) as service, service.track(plan_id, rooms=["kitchen"]) as tracker:
            return (await tracker.add(path)).photographs

    assert asyncio.run(follow()) == 1


@pytest.mark.parametrize(("heading_deg", "yaw"), [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (270.0, 180.0)])
def test_yaw_is_counter_clockwise_from_x(heading_deg: float, yaw: float) -> None:
    assert yaw_of(heading_deg) == pytest.approx(math.radians(yaw))
    assert heading_of(math.radians(yaw)) == pytest.approx(heading_deg)


def test_ros_pose_has_the_layout_of_the_message() -> None:
    pose = ros_pose(pose_at(0.0))
    assert pose.position == (2.0, 3.0, 1.5)
    assert pose.orientation == pytest.approx((0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))
    covariance = np.array(pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(covariance, covariance.T)
    assert covariance[0, 1] == 0.01
    # The yaw turns against the heading.
    assert covariance[0, 5] == pytest.approx(-0.3 * math.radians(1.0))
    assert covariance[5, 5] == pytest.approx(4.0 * math.radians(1.0) ** 2)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 200.0])
def test_camera_matrices_look_along_the_heading(heading_deg: float) -> None:
    pose, heading = pose_at(heading_deg), math.radians(heading_deg)
    ahead = 2.0 + math.sin(heading), 3.0 + math.cos(heading)
    opengl, unity = (np.array(camera_matrix(pose, name)) for name in ("opengl", "unity"))
    np.testing.assert_allclose(opengl @ [0.0, 0.0, -1.0, 1.0], [ahead[0], 1.5, -ahead[1], 1.0])
    np.testing.assert_allclose(unity @ [0.0, 0.0, 1.0, 1.0], [ahead[0], 1.5, ahead[1], 1.0])
    assert np.linalg.det(opengl[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.det(unity[:3, :3]) == pytest.approx(1.0)
    right = 2.0 + math.cos(heading), 3.0 - math.sin(heading)
    np.testing.assert_allclose(opengl @ [1.0, 0.0, 0.0, 1.0], [right[0], 1.5, -right[1], 1.0])
    np.testing.assert_allclose(unity @ [1.0, 0.0, 0.0, 1.0], [right[0], 1.5, right[1], 1.0])


@pytest.mark.parametrize("mirrored", [False, True])
def test_two_points_align_the_frames(mirrored: bool) -> None:
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    flip = np.diag([1.0, -1.0 if mirrored else 1.0])
    plan = [(1.0, 1.0), (4.0, 2.0), (0.0, 5.0)]
    world = [tuple(flip @ (turn @ np.array(point) + [3.0, -2.0])) for point in plan]
    matrix = np.array(world_from_plan(plan[:2], world[:2], mirrored=mirrored))
    np.testing.assert_allclose(matrix @ [0.0, 5.0, 1.0], [*world[2], 1.0], atol=1e-9)


def test_places_too_close_to_align_are_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.20 m apart; the minimum is 0\.5 m"):
        world_from_plan([(0.0, 0.0), (0.2, 0.0)], [(0.0, 0.0), (0.2, 0.0)])
    with pytest.raises(ValueError, match="at least two of both"):
        world_from_plan([(0.0, 0.0)], [(0.0, 0.0)])


def test_places_that_do_not_fit_are_refused() -> None:
    plan = [(0.0, 0.0), (3.0, 0.0), (3.0, 2.0)]
    with pytest.raises(ValueError, match=r"are 3\.28 times those in the plan; at most 1\.3 times fit"):
        world_from_plan(plan, [(0.0, 0.0), (9.84, 0.0), (9.84, 6.56)])
    mirrored = [(x, -y) for x, y in plan]
    with pytest.raises(ValueError, match=r"with 0\.00 m if one axis of the world is turned over: .* mirrored=True"):
        world_from_plan(plan, mirrored)
    assert misfit_m(world_from_plan(plan, mirrored, mirrored=True), plan, mirrored) == pytest.approx(
        [0.0] * 3, abs=1e-9
    )
    with pytest.raises(ValueError, match=r"the places fit with \d\.\d\d m; the limit is 0\.\d\d m"):
        world_from_plan(plan, [plan[1], plan[2], plan[0]])


def test_misfit_is_that_of_each_place() -> None:
    plan, world = [(0.0, 0.0), (4.0, 0.0)], [(1.0, 1.0), (1.0, 5.4)]
    assert misfit_m(world_from_plan(plan, world), plan, world) == pytest.approx([0.2, 0.2])
