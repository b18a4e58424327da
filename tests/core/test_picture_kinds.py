"""Photographs given as plans, plans given as photographs, and maps and texts given as either."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image, ImageDraw

from benchmarks.plan_drawing import STYLES, Style, draw_plan
from lalaloc_core.errors import InvalidFloorPlanError, InvalidPhotographError
from lalaloc_core.file_kinds import Tones, is_drawing
from lalaloc_core.importers import import_plan
from lalaloc_core.importers.drawing.sketch_drawing import text_hints
from lalaloc_core.importers.drawing.vector_drawing import Lettering
from lalaloc_core.photograph import StatedCamera, open_photograph
from tests.core.taken import EXAMPLES
from tests.painted import picture_file
from tests.strategies import present

PHOTOGRAPHS = sorted([*EXAMPLES.glob("*.jpg"), *EXAMPLES.glob("real/*.jpg")])


def test_photographs_are_not_taken_for_drawings() -> None:
    pictures = [np.asarray(Image.open(path).convert("RGB")) for path in PHOTOGRAPHS]
    assert len(pictures) > 5
    assert not any(map(is_drawing, [*pictures, *(picture // 4 for picture in pictures)]))


@pytest.mark.parametrize("shade", [255, 128, 0])
def test_plain_pictures_are_neither(shade: int) -> None:
    tones = present(Tones.of(np.full((300, 400), shade, np.uint8)))
    assert not tones.is_drawing
    assert not tones.is_photograph
    assert Tones.of(np.zeros((8, 900), np.uint8)) is None


@pytest.mark.parametrize(("still", "edges"), [(0.85, 0.06), (0.6, 0.06), (0.85, 0.02)])
def test_uneven_picture_with_lines_and_flat_areas_is_no_photograph(still: float, edges: float) -> None:
    # Flat, spread, darkest, uniform, ink, strokes, between and step are those of a plan with coloured rooms.
    tones = Tones(0.5, 120.0, 100.0, 0.4, 0.1, 0.1, 0.2, 50.0, still, edges)
    assert tones.is_photograph != (still > 0.75 and edges > 0.035)


@pytest.mark.parametrize("style", STYLES)
def test_drawn_and_scanned_plans_are_not_taken_for_photographs(style: Style) -> None:
    drawn = draw_plan(style, 3)
    content = drawn.jpeg() if style == "scanned" else drawn.png()
    tones = present(Tones.of(np.asarray(Image.open(io.BytesIO(content)).convert("L"))))
    assert not tones.is_photograph


@pytest.mark.parametrize(
    "style", ["coloured", *(pytest.param(style, marks=pytest.mark.slow) for style in ("thin", "thick", "hatched"))]
)
def test_plans_with_coloured_rooms_are_drawings(style: Style) -> None:
    picture = Image.open(io.BytesIO(draw_plan(style, 3).png())).convert("RGB")
    rng = np.random.default_rng(0)
    for x, y in rng.integers(picture.size, size=(60, 2)).tolist():
        if np.asarray(picture)[y, x].min() > 235:
            ImageDraw.floodfill(picture, (x, y), tuple(rng.integers(150, 245, 3).tolist()), thresh=30)
    content = picture_file(picture.resize((picture.width // 2, picture.height // 2)), "JPEG", quality=70)
    assert is_drawing(np.asarray(Image.open(io.BytesIO(content))))


@pytest.mark.parametrize("seed", range(5))
def test_scanned_plans_are_drawings(seed: int) -> None:
    picture = np.asarray(Image.open(io.BytesIO(draw_plan("scanned", seed).jpeg())).convert("RGB"))
    assert all(map(is_drawing, (picture, 255 - picture)))


@pytest.mark.parametrize("name", ["real/hotel_room.jpg", "phone.jpg", "turn_1.jpg", "kitchen.jpg"])
def test_photograph_given_as_a_plan_is_refused_before_its_scale_is_asked(name: str) -> None:
    with pytest.raises(InvalidFloorPlanError, match="looks like a photograph, not like a floor plan"):
        import_plan((EXAMPLES / name).read_bytes())


@pytest.mark.parametrize("stated", [StatedCamera(projection="perspective", hfov_deg=70.0), None])
def test_plan_given_as_a_photograph_is_refused(stated: StatedCamera | None) -> None:
    picture = Image.open(io.BytesIO(draw_plan("thick", 1).png())).convert("RGB")
    # Also one that is twice as wide as high, like a sphere.
    wide = Image.new("RGB", (2 * picture.height, picture.height), "white")
    wide.paste(picture.resize((picture.height, picture.height)))
    content = picture_file(picture if stated is not None else wide)
    stated = stated or StatedCamera(projection="equirectangular")
    with pytest.raises(InvalidPhotographError, match="is a drawing or a page of text, not a photograph"):
        open_photograph(content, sphere_size=(256, 512), stated=stated)


def test_errors_name_a_page_of_text() -> None:
    prose = [Lettering("The tenant pays the rent until the third day", (0.0, 20.0 * line)) for line in range(20)]
    assert [hint[:43] for hint in text_hints(prose, "the picture")] == ["the picture is a page of text with 20 lines"]
    labels = [Lettering(name, (0.0, 0.0)) for name in ("Kitchen", "Hall", "4.20")] * 10
    assert text_hints([*labels, *prose[:9]], "the picture") == []


def test_map_of_streets_is_refused() -> None:
    ring = [[[11, 48], [11.0002, 48], [11.0002, 48.0001], [11, 48]]]
    shapes = [({"building": "yes"}, "Polygon", ring), ({"highway": "residential"}, "LineString", ring[0][:2])]
    features = [
        {"type": "Feature", "properties": tags, "geometry": {"type": kind, "coordinates": points}}
        for tags, kind, points in shapes
    ]
    with pytest.raises(InvalidFloorPlanError, match="is a map with 1 outdoor features"):
        import_plan(json.dumps({"type": "FeatureCollection", "features": features}).encode())
