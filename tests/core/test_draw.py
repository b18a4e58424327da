"""Pictures of answers: lines in the photograph, colours and marks on the plan."""

from __future__ import annotations

import io
import math
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from lalaloc_core.conventions import TWO_PI, column_azimuths, wrap_angle
from lalaloc_core.draw import canvas, rasterise
from lalaloc_core.draw.answer import DrawnAnswer, Picture, confidence_words, draw_answer, ellipse_m
from lalaloc_core.draw.heat import Cells, HeatMap, heat_image, posterior_map
from lalaloc_core.draw.outline import layout_outline
from lalaloc_core.draw.plan import Marker
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.answers.documents import Position, PossiblePose
from lalaloc_core.localise.belief import ProbabilityMap
from lalaloc_core.render.sampling import PoseSet, pose_grid
from lalaloc_core.render.sweep import profiles_at

SVG = "{http://www.w3.org/2000/svg}"
PLAN = FloorPlan.from_dict(
    {
        "name": "Flat <&>",
        "ceiling_height_m": 2.5,
        "rooms": [
            {"name": "hall", "polygon": [[0, 0], [4, 0], [4, 6], [0, 6]]},
            {"name": "<kitchen> & more", "polygon": [[4.1, 0], [8, 0], [8, 2], [6, 2], [6, 6], [4.1, 6]]},
        ],
        "openings": [
            {"kind": "door", "line": [[4.05, 4], [4.05, 5]]},
            {"kind": "window", "line": [[1, 6], [3, 6]], "sill_m": 1.0, "head_m": 2.0},
            {"kind": "passage", "line": [[1, 0], [3, 0]]},
        ],
    }
)
EYE_M = 1.5
MIDDLE = np.array([2.0, 3.0])


def rival(x_m: float, y_m: float, heading_deg: float, room: str, probability: float | None) -> PossiblePose:
    return PossiblePose(
        position=Position(x_m=x_m, y_m=y_m),
        heading_deg=heading_deg,
        room=room,
        room_id=room,
        probability=probability,
        cost=0.0,
        latent_distance=0.0,
    )


def answer(**changes: Any) -> DrawnAnswer:
    values: dict = {
        "plan": PLAN,
        "camera": Marker(x_m=2.0, y_m=3.0, heading_deg=30.0, covariance_m2=(0.04, 0.0, 0.01)),
        "room_index": 0,
        "camera_height_m": EYE_M,
        "heading_source": "given",
        "confidence": 0.7,
        "rivals": (rival(5.0, 4.0, 210.0, "<kitchen> & more", 0.2), rival(7.0, 1.0, 0.0, "hall", 0.0)),
    }
    return DrawnAnswer(**(values | changes))


@pytest.mark.parametrize("heading", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("room", [0, 1])
def test_wall_lines_match_the_renderer(room: int, heading: float) -> None:
    position_m = np.array([MIDDLE, [5.0, 1.0]][room])
    outline = layout_outline(PLAN, position_m, room, heading, EYE_M)
    columns = 512
    profile_m = profiles_at(PLAN, position_m[None], np.array([room]), np.array([heading]), columns)[0]
    for line, rise_m in zip(outline.edges, (-EYE_M, 1.0), strict=False):
        expected = np.stack([(np.arange(columns) + 0.5) / columns, 0.5 - np.arctan2(rise_m, profile_m) / np.pi], axis=1)
        drawn = np.interp(expected[:, 0], line[:, 0], line[:, 1])
        # Next to corners either wall is correct.
        assert np.quantile(np.abs(drawn - expected[:, 1]), 0.98) < 1e-4
        assert line[0, 0] == pytest.approx(0.0)
        assert line[-1, 0] == pytest.approx(1.0)


def test_corners_match_the_plan() -> None:
    heading = 0.7
    outline = layout_outline(PLAN, MIDDLE, 0, heading, EYE_M)
    offset = PLAN.rooms[0].polygon_m - MIDDLE
    azimuth = np.sort(wrap_angle(np.arctan2(offset[:, 0], offset[:, 1]) - heading))
    corners = np.stack(outline.edges[2:])
    np.testing.assert_allclose(np.sort(corners[:, 0, 0]), azimuth / TWO_PI + 0.5, atol=1e-4)
    distance_m = float(np.hypot(*offset[0]))
    np.testing.assert_allclose(corners[:, 0, 1], 0.5 + math.atan(EYE_M / distance_m) / math.pi, atol=1e-4)
    np.testing.assert_allclose(corners[:, 1, 1], 0.5 - math.atan(1.0 / distance_m) / math.pi, atol=1e-4)


def test_openings_are_drawn_and_split_at_the_edge() -> None:
    outline = layout_outline(PLAN, MIDDLE, 0, 0.0, EYE_M)
    kinds = [opening.kind for opening in outline.openings]
    # The passage is behind the camera: half of it at each edge.
    assert sorted(kinds) == ["door", "passage", "passage", "window"]
    window = next(opening.line for opening in outline.openings if opening.kind == "window")
    assert window[:, 0].min() == pytest.approx(0.5 - math.atan(1 / 3) / TWO_PI)
    assert window[:, 0].max() == pytest.approx(0.5 + math.atan(1 / 3) / TWO_PI)
    # Its centre is 3 m away; its edges are 0.5 m below and above the eye.
    assert window[:, 1].max() == pytest.approx(0.5 + math.atan(0.5 / 3) / math.pi, abs=1e-4)
    assert window[:, 1].min() == pytest.approx(0.5 - math.atan(0.5 / 3) / math.pi, abs=1e-4)
    for opening in outline.openings:
        assert np.abs(np.diff(opening.line[:, 0])).max() < 0.1, "no line runs across the whole picture"
        np.testing.assert_array_equal(opening.line[0], opening.line[-1])


def test_hidden_openings_are_not_drawn() -> None:
    document = PLAN.to_dict()
    document["rooms"][1]["walls"] = [[[4.8, 3.6], [4.8, 5.6]]]
    hidden = FloorPlan.from_dict(document)
    position_m = np.array([5.6, 4.6])
    assert [opening.kind for opening in layout_outline(PLAN, position_m, 1, 0.0, EYE_M).openings] == ["door"]
    assert layout_outline(hidden, position_m, 1, 0.0, EYE_M).openings == ()


def test_round_room_has_no_corners() -> None:
    azimuth = column_azimuths(480)
    ring = np.stack([3.0 * np.sin(azimuth), 3.0 * np.cos(azimuth)], axis=1)[::-1]
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": [{"name": "round", "polygon": ring.tolist()}]})
    outline = layout_outline(plan, np.zeros(2), 0, 0.0, EYE_M)
    assert len(outline.edges) == 2
    np.testing.assert_allclose(outline.edges[0][:, 1], 0.5 + math.atan(0.5) / math.pi, atol=1e-5)


def all_places(probability: np.ndarray, poses: PoseSet) -> ProbabilityMap:
    return ProbabilityMap(poses.position_m, poses.room_index, probability / probability.sum())


def test_most_probable_cell_is_darkest() -> None:
    # Between grid poses, like most answers.
    place_m = np.array([1.18, 4.07])
    heat = posterior_map(PLAN, ProbabilityMap(place_m[None], np.zeros(1, int), np.ones(1)), 0.5)
    distance_m = np.linalg.norm(heat.cells.poses.position_m - place_m, axis=1)
    assert heat.shade[distance_m.argmin()] == pytest.approx(1.0, abs=0.01)
    assert np.argsort(distance_m)[:4].tolist().count(int(heat.shade.argmax())) == 1
    assert heat.shade[distance_m < 0.2].min() > heat.shade[distance_m > 0.5].max()
    assert heat.shade[distance_m > 1.1].max() == 0.0
    assert heat.shade[heat.cells.poses.room_index == 1].max() == 0.0, "walls part the colours of rooms"


def test_shade_is_logarithmic_in_probability() -> None:
    poses = pose_grid(PLAN, 0.5)
    # A factor of 0.1 per metre to the right.
    probability = np.where(poses.room_index == 0, 10.0 ** poses.position_m[:, 0], 0.0)
    heat = posterior_map(PLAN, all_places(probability, poses), 0.5)
    inside = heat.cells.poses.room_index == 0
    (x_m, y_m), shade = heat.cells.poses.position_m[inside].T, heat.shade[inside]
    between = (x_m > 0.8) & (x_m < 3.2) & (np.abs(y_m - y_m.mean()) < 0.6)
    slope, start = np.polyfit(x_m[between], shade[between], 1)
    assert slope == pytest.approx(0.2, abs=0.01)
    np.testing.assert_allclose(shade[between], start + slope * x_m[between], atol=0.02)
    heat = posterior_map(PLAN, all_places(np.ones(len(poses)), poses), 0.5)
    off_m = np.abs(heat.cells.poses.position_m[:, None] - poses.position_m).max(axis=2).min(axis=1)
    assert heat.shade[off_m <= 0.25].min() > 0.85
    assert np.median(heat.shade) > 0.9


def colours(heat: HeatMap) -> np.ndarray:
    size = Cells.cover(PLAN, 0.05).room.shape
    drawn = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 -6 8 6" width="{size[1]}">{heat_image(heat, PLAN)}</svg>'
    )
    with Image.open(io.BytesIO(rasterise(drawn))) as picture:
        return np.asarray(picture.convert("RGBA"))


def test_heat_map_colours_floors_only() -> None:
    cells = Cells.cover(PLAN, 0.1)
    shown = colours(HeatMap(cells, np.ones(len(cells.poses)), "", ()))
    height, width = shown.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    x_m, y_m = (columns.ravel() + 0.5) / width * 8.0, 6.0 - (rows.ravel() + 0.5) / height * 6.0
    inside = PLAN.room_index_at(np.stack([x_m, y_m], axis=1)) >= 0
    opaque = shown[..., 3].ravel() > 127
    assert (opaque == inside).mean() > 0.98


@pytest.mark.parametrize("picture", ["both", "plan", "photograph"])
def test_answer_picture_has_all_parts(picture: Picture) -> None:
    heat = posterior_map(PLAN, all_places(np.ones(len(poses := pose_grid(PLAN, 0.5))), poses), 0.5)
    photograph = np.full((128, 256, 3), 90, np.uint8)
    drawn = draw_answer(answer(heat=heat), photograph, picture)
    root = ElementTree.fromstring(drawn)
    classes = [element.get("class") for element in root.iter()]
    words = " ".join(text.strip() for text in root.itertext())
    assert ("layout" in classes) == (picture != "plan")
    assert ("camera" in classes) == ("rival" in classes) == (picture != "photograph")
    assert "x 2.00 m, y 3.00 m" in words
    assert "heading 30.0° (given)" in words
    if picture != "photograph":
        assert classes.count("rival") == 1, "what is as good as impossible is no rival"
        assert {"70.0 %", "within 1 m: likely", "20.0 %"} <= {text.strip() for text in root.itertext()}
    with Image.open(io.BytesIO(rasterise(drawn))) as image:
        assert image.format == "PNG"
        assert image.width == 1600
        assert image.height == int(root.attrib["height"])


def test_picture_without_photograph_or_confidence() -> None:
    with pytest.raises(ValueError, match="photograph is None; picture='both'"):
        draw_answer(answer())
    assert "<image" not in draw_answer(answer(), picture="plan")
    bare = answer(confidence=None, rivals=(rival(5.0, 4.0, 210.0, "kitchen", None),))
    words = " ".join(ElementTree.fromstring(draw_answer(bare, picture="plan")).itertext())
    assert "within 1 m" not in words
    assert "kitchen" in words


def test_near_candidates_are_drawn_as_one_place() -> None:
    rivals = [(2.5, 3.5, 0.1), (5.0, 4.0, 0.2), (5.0, 4.9, 0.05), (7.0, 1.0, 0.04)]
    places = answer(rivals=tuple(rival(x_m, y_m, 0.0, "kitchen", share) for x_m, y_m, share in rivals))
    root = ElementTree.fromstring(draw_answer(places, picture="plan"))
    assert [element.get("class") for element in root.iter()].count("rival") == 2
    texts = {text.strip() for text in root.itertext()}
    assert {"25.0 %", "4.0 %"} <= texts
    assert not {"10.0 %", "5.0 %"} & texts


def test_ellipse_axes_match_the_covariance_and_confidence_words_are_distinct() -> None:
    assert ellipse_m((0.01, 0.0, 0.04)) == pytest.approx((0.4895, 0.2448), abs=1e-3)
    assert ellipse_m((0.025, 0.015, 0.025)) == pytest.approx((0.4895, 0.2448), abs=1e-3)
    descriptions = [confidence_words(value) for value in (1.0, 0.9, 0.6, 0.3, 0.0)]
    assert len(set(descriptions)) == 5


@pytest.mark.parametrize(
    "names", [("台所", "寝室"), ("부엌", "침실"), ("厨房间", "卧室床"), ("مطبخ", "حمام"), ("κουζίνα", "λουτρό!")]
)
def test_names_in_any_bundled_script_are_drawn_and_not_boxes(names: tuple[str, str]) -> None:
    def drawn(text: str) -> np.ndarray:
        return np.asarray(canvas.pixels(canvas.document(200, 60, "", [canvas.words(5, 45, text, 40)])))

    first, second, boxes = drawn(names[0]), drawn(names[1]), drawn("\ue000" * len(names[0]))
    # Two words of equal length without their characters are the same boxes.
    assert np.any(first != second)
    assert np.any(first != boxes)
    assert (first < 128).sum() > 100
