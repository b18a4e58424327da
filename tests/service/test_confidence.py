"""Tests of the shipped model's confidence, on photographs of the plan's home and on other pictures.

The homes are rendered from the validation split, outside the range that the calibration uses.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import EXAMPLES, jpeg, sphere, take
from tests.painted import painted_room, picture_file
from tests.service.conftest import document_of, localise, upload
from tests.strategies import plan_document, rectangle

HOMES = 12
FIRST_HOME = 1000
HEIGHT, WIDTH = 128, 256
# Typical error of a compass.
TOLERANCE_DEG = 5.0


@dataclass(frozen=True)
class Shot:
    """Rendered photograph of a home."""

    plan: dict[str, Any]
    picture: bytes
    position_m: np.ndarray
    heading_deg: float
    camera_height_m: float


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    """Return one photograph per home."""
    source = GeneratedScenes(homes=FIRST_HOME + HOMES, shots_per_home=1)
    found = []
    for number in range(FIRST_HOME, FIRST_HOME + HOMES):
        scene = source.load(f"validation-{number:05d}")
        camera = scene.cameras[0]
        picture = picture_file(camera.photographs[source.appearances[0]].image(HEIGHT, WIDTH))
        # One grid per home is enough if the plan has the height of the camera.
        plan = {**scene.plan.to_dict(), "camera_height_m": round(camera.camera_height_m, 2)}
        height_m = plan["camera_height_m"]
        found.append(Shot(plan, picture, camera.position_m, np.degrees(camera.heading) % 360.0, height_m))
    return found


@pytest.fixture(scope="module")
def homes(shipped: httpx.Client, shots: list[Shot]) -> list[str]:
    """Return the ids of the uploaded plans, in the order of `shots`."""
    return [upload(shipped, shot.plan) for shot in shots]


@pytest.fixture(scope="module", params=["heading given", "heading searched"])
def given(request: pytest.FixtureRequest) -> bool:
    return request.param == "heading given"


@pytest.fixture(scope="module")
def right(shipped: httpx.Client, shots: list[Shot], homes: list[str], given: bool) -> list[dict[str, Any]]:
    """Return the answer to each photograph in its own home."""
    pairs = zip(shots, homes, strict=True)
    return [ask(shipped, home, shot.picture, shot.heading_deg if given else None) for shot, home in pairs]


def blank(value: int) -> bytes:
    """Return a picture of a wall directly in front of the camera."""
    return picture_file(np.full((HEIGHT, WIDTH, 3), value, np.uint8))


def outdoors(sky: tuple[int, int, int], ground: tuple[int, int, int]) -> bytes:
    """Return a picture of a plain under a sky that is paler towards the horizon, with grain."""
    up = np.linspace(1.0, -1.0, HEIGHT)[:, None, None]
    colours = np.where(up > 0.0, np.array(sky) + 60.0 * (1.0 - up), np.array(ground) * (0.7 - 0.3 * up))
    grain = np.random.default_rng(0).normal(0.0, 6.0, (HEIGHT, WIDTH, 3))
    return picture_file(np.clip(colours + grain, 0.0, 255.0).astype(np.uint8))


PICTURES_OF_NO_ROOM = {
    "grey": blank(128),
    "white": blank(245),
    "meadow": outdoors((80, 130, 190), (90, 120, 60)),
    "beach": outdoors((120, 150, 180), (190, 170, 120)),
}


def ask(client: httpx.Client, plan_id: str, picture: bytes, heading_deg: float | None, **fields: Any) -> dict[str, Any]:
    """Return an answer of the last stage."""
    if heading_deg is not None:
        fields["heading_deg"] = heading_deg
    answer = document_of(localise(client, plan_id, picture, **fields))
    assert answer["stage"] == "lpo"
    return answer


def confidences(answers: list[dict[str, Any]]) -> np.ndarray:
    return np.array([answer["confidence"] for answer in answers])


@pytest.mark.slow
def test_photograph_of_the_home_is_trusted(right: list[dict[str, Any]]) -> None:
    assert np.median(confidences(right)) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("picture", PICTURES_OF_NO_ROOM.values(), ids=PICTURES_OF_NO_ROOM.keys())
def test_picture_of_no_room_is_not_trusted(
    shipped: httpx.Client, homes: list[str], given: bool, picture: bytes
) -> None:
    heading_deg = 0.0 if given else None
    answers = [ask(shipped, home, picture, heading_deg, projection="equirectangular") for home in homes[:4]]
    assert confidences(answers).max() < 0.1


def upside_down(picture: np.ndarray) -> np.ndarray:
    return picture[::-1, ::-1]


def cut_out(picture: np.ndarray) -> np.ndarray:
    """Return the view of an ordinary camera, enlarged to the size of a sphere."""
    part = Image.fromarray(picture[HEIGHT // 3 : 2 * HEIGHT // 3, WIDTH // 4 : WIDTH // 2])
    return np.array(part.resize((WIDTH, HEIGHT), Image.Resampling.BILINEAR))


@pytest.mark.slow
@pytest.mark.parametrize("change", [upside_down, cut_out])
def test_changed_sphere_is_not_trusted(
    shipped: httpx.Client, shots: list[Shot], homes: list[str], given: bool, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    answers = []
    for shot, home in zip(shots, homes, strict=True):
        changed = change(np.array(Image.open(io.BytesIO(shot.picture))))
        answers.append(
            ask(shipped, home, picture_file(changed), shot.heading_deg if given else None, projection="equirectangular")
        )
    # Some rooms look similar upside down, and some parts of a room look like a room.
    assert np.mean(confidences(answers) < 0.1) > 0.6
    assert confidences(answers).mean() < 0.25


@pytest.mark.slow
def test_photograph_of_another_home_is_rarely_trusted(
    shipped: httpx.Client, shots: list[Shot], homes: list[str], given: bool
) -> None:
    pairs = zip(shots, homes[1:] + homes[:1], strict=True)
    foreign = [ask(shipped, home, shot.picture, shot.heading_deg if given else None) for shot, home in pairs]
    # Some homes have a similar room.
    assert np.mean(confidences(foreign) < 0.1) >= 0.7
    assert confidences(foreign).mean() < 0.25


@pytest.mark.slow
def test_answer_has_a_covariance(right: list[dict[str, Any]], given: bool) -> None:
    for answer in right:
        covariance = np.array(answer["covariance_m2"])
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() >= 0.0
        assert (answer["heading_std_deg"] is None) == given
    assert np.median([np.sqrt(np.trace(answer["covariance_m2"])) for answer in right]) < 0.5


@pytest.mark.slow
def test_covariance_matches_the_errors(shots: list[Shot], right: list[dict[str, Any]]) -> None:
    distances = []
    for shot, answer in zip(shots, right, strict=True):
        offset = np.array([answer["position"]["x_m"], answer["position"]["y_m"]]) - shot.position_m
        if np.hypot(*offset) < 1.0:
            distances.append(offset @ np.linalg.solve(np.array(answer["covariance_m2"]), offset))
    assert len(distances) >= HOMES // 2
    # 50 % should be below 1.4 and 95 % below 6; a few answers only show the order of magnitude.
    assert 0.15 < np.median(distances) < 10.0


@pytest.mark.slow
def test_compass_heading_is_corrected(shipped: httpx.Client, shots: list[Shot], homes: list[str]) -> None:
    off = []
    for shot, home in list(zip(shots, homes, strict=True))[:6]:
        wrong_deg = shot.heading_deg + 0.8 * TOLERANCE_DEG
        answer = ask(shipped, home, shot.picture, wrong_deg % 360.0, heading_tolerance_deg=TOLERANCE_DEG)
        assert answer["heading_std_deg"] > 0.0
        off.append(abs((answer["heading_deg"] - shot.heading_deg + 180.0) % 360.0 - 180.0))
    assert np.median(off) < 0.4 * TOLERANCE_DEG


@pytest.mark.slow
def test_right_heading_is_not_doubted(right: list[dict[str, Any]], given: bool) -> None:
    assert sum(bool(answer["warnings"]) for answer in right) <= 1
    if given:
        assert np.median([answer["heading_confidence"] for answer in right]) > 0.7


@pytest.mark.parametrize(("size_m", "ways"), [((3.2, 4.6), 2), ((3.2, 3.2), 4)], ids=["rectangle", "square"])
def test_plain_room_splits_between_its_headings(shipped: httpx.Client, size_m: tuple[float, float], ways: int) -> None:
    room = upload(shipped, plan_document(rectangle(*size_m), camera_height_m=1.5))
    picture = painted_room(size_m, (0.8, 1.0))
    answer = ask(shipped, room, picture, None, top_k=5)
    shares = [candidate["probability"] for candidate in answer["candidates"]]
    assert shares[:ways] == pytest.approx([1.0 / ways] * ways, abs=0.08)
    assert answer["confidence"] <= 1.0 / ways + 0.05
    assert answer["heading_confidence"] <= 1.0 / ways + 0.05
    turns = {round(candidate["heading_deg"] / (360.0 / ways)) % ways for candidate in answer["candidates"][:ways]}
    assert turns == set(range(ways))
    # A known heading removes the ambiguity.
    assert ask(shipped, room, picture, 0.0)["confidence"] > 1.0 / ways + 0.1


def test_plain_corridor_is_uncertain_along_only(shipped: httpx.Client, given: bool) -> None:
    corridor = upload(shipped, plan_document(rectangle(40.0, 1.8), camera_height_m=1.5))
    answer = ask(shipped, corridor, painted_room((40.0, 1.8), (15.0, 0.8)), 0.0 if given else None)
    assert answer["confidence"] < 0.25
    across, along = np.linalg.eigvalsh(np.array(answer["covariance_m2"]))
    assert along > 25.0 * across
    assert answer["covariance_m2"][0][0] == pytest.approx(along, rel=0.05)
    assert min(abs(answer["position"]["y_m"] - y_m) for y_m in (0.8, 1.0)) < 0.15


def test_unsure_answer_has_a_next_step_and_a_sure_one_none(shipped: httpx.Client, home: str) -> None:
    wall = jpeg(take(sphere("living_room"), Perspective.of_hfov(480, 640, np.radians(53.0)), heading_deg=220.0))
    unsure = ask(shipped, home, wall, None, hfov_deg=53.0)
    assert unsure["confidence"] < 0.5 < 1.0 - unsure["probability_elsewhere"]
    step = unsure["view"]["next_step"]
    assert unsure["confidence"] + 0.02 <= step["expected_confidence"] <= 1.0
    assert step["expected_bits"] > 0.0
    assert (step["turn_deg"] is None) == (step["kind"] in ("heading", "rooms"))
    assert "; the expected confidence is then " in step["text"]
    assert 0.0 < unsure["timings_ms"]["next_step"] < unsure["timings_ms"]["total"]
    assert ask(shipped, home, wall, None, hfov_deg=53.0)["view"]["next_step"] == step
    sure = ask(shipped, home, (EXAMPLES / "kitchen.jpg").read_bytes(), None)
    assert sure["confidence"] >= 0.5
    assert sure["view"]["next_step"] is None
