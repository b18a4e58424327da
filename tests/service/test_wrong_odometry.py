"""Odometry that photographs contradict is named in answers, with the shipped model."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest

from tests.core.taken import sphere
from tests.painted import picture_file
from tests.service.conftest import document_of
from tests.service.test_sessions import begin, send

# The robot turns on the spot.
TURN_DEG = 45.0


@pytest.fixture(scope="module")
def turning() -> list[bytes]:
    """Return photographs of a camera that turns clockwise on the spot."""
    files, pixels = [], sphere("kitchen")
    for number in range(6):
        turned = np.roll(pixels, -round(number * TURN_DEG / 360.0 * pixels.shape[1]), axis=1)
        files.append(picture_file(turned, "JPEG"))
    return files


def follow(client: httpx.Client, plan_id: str, photos: list[bytes], **motion: Any) -> list[dict[str, Any]]:
    """Return the poses of photographs with the same stated motion between all of them."""
    session_id = begin(client, plan_id, camera_height_m=1.5)
    answers = [send(client, session_id, photo, **(motion if number else {})) for number, photo in enumerate(photos)]
    return [document_of(answer)["pose"] for answer in answers]


def test_right_odometry_is_not_contradicted(shipped: httpx.Client, home: str, turning: list[bytes]) -> None:
    poses = follow(shipped, home, turning, forward_m=0, turn_deg=TURN_DEG)
    assert [pose["motion_contradicted"] for pose in poses] == [[]] * len(poses)
    assert all(pose["probability"] > 0.5 for pose in poses[2:])
    assert [pose["warnings"] for pose in poses] == [[]] * len(poses)


@pytest.mark.parametrize(
    ("motion", "component"),
    [
        ({"forward_m": 0, "turn_deg": -TURN_DEG}, "turn_deg"),
        ({"forward_m": 2.5, "turn_deg": TURN_DEG}, "forward_m"),
        ({"forward_m": 0, "right_m": -2.5, "turn_deg": TURN_DEG}, "right_m"),
    ],
    ids=["sign of the turn", "slipping wheels", "sideways"],
)
def test_wrong_odometry_is_named(
    shipped: httpx.Client, home: str, turning: list[bytes], motion: dict[str, Any], component: str
) -> None:
    poses = follow(shipped, home, turning, **motion)
    # The photographs are believed.
    assert {pose["room"] for pose in poses} == {"kitchen"}
    assert [component in pose["motion_contradicted"] for pose in poses[1:]] == [True] * (len(poses) - 1)
    stated = (
        f"{component} is {motion[component]:g}, which the photographs contradict by more than 4 standard deviations"
    )
    assert stated in poses[1]["warnings"]
    assert len(poses[1]["warnings"]) == len(poses[1]["motion_contradicted"])
    again = f"{component} contradicts at least 3 of the last 8 photographs: check its sign, unit and standard deviation"
    assert again in poses[-1]["warnings"]
