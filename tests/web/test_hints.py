"""Hints on the start page, and the picture of an answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from lalaloc_core.floorplan.earth import Anchor
from tests.service.conftest import StartApp
from tests.web.conftest import Visit, visit
from tests.web.test_answer import _assert_accessible, _copied


@pytest.mark.slow
def test_hints_are_set_and_sent(desktop: Visit) -> None:
    page = desktop.open_example()
    page.locator("#hints summary").click()
    page.get_by_role("button", name="Mark the place on the plan").click()
    # The mark appears at once, for the keyboard; a click moves it.
    mark = page.locator(".hint-circle .grip")
    expect(mark).to_be_focused()
    before = float(mark.get_attribute("cx") or 0)
    page.keyboard.press("Shift+ArrowRight")
    expect(mark).not_to_have_attribute("cx", str(before))
    moved = mark.get_attribute("cx") or ""
    assert float(moved) == pytest.approx(before + 1.0)
    plan = page.locator("#plan").bounding_box()
    assert plan is not None
    page.mouse.click(plan["x"] + 0.7 * plan["width"], plan["y"] + 0.65 * plan["height"])
    expect(mark).not_to_have_attribute("cx", moved)
    page.locator("#hint-radius").fill("2.5")
    page.get_by_role("checkbox", name="kitchen").check()
    expect(page.locator("#hints-summary")).to_contain_text("within 2.5 m of the mark, in one room")
    _assert_accessible(page)
    desktop.find()
    sent = _copied(page, "#copy-curl")
    assert all(field in sent for field in ("near={", "radius_m=2.5", 'rooms=["kitchen"]'))
    code = _copied(page, "#copy-python")
    assert 'near={"x_m":' in code
    assert 'radius_m=2.5, rooms=["kitchen"]' in code
    # Hints belong to one photograph; an invalid one marks its field.
    page.locator(".thumb").nth(1).click()
    expect(mark).to_have_count(0)
    page.locator(".thumb").first.click()
    page.get_by_text("Heading and hints").click()
    page.locator("#hint-radius").fill("0")
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#photo-error")).to_contain_text("Radius")
    expect(page.locator("#hint-radius")).to_have_attribute("aria-invalid", "true")
    page.get_by_role("button", name="Remove the mark").click()
    expect(mark).to_have_count(0)
    desktop.find()


def test_mark_on_earth_agrees_with_the_service(desktop: Visit) -> None:
    page = desktop.open()
    for anchor, distance_m, error_m in (
        (Anchor(51.75, -1.25, north_deg=30.0), 300.0, 0.001),
        (Anchor(-33.9, 151.2, north_deg=0.0), 1000.0, 0.01),
        (Anchor(64.1, -21.9, north_deg=200.0), 10_000.0, 0.2),
    ):
        points = distance_m * np.array([[0.6, -0.8], [-1.0, 0.0], [0.0, 1.0]])
        given = {"latitude": anchor.latitude, "longitude": anchor.longitude, "north_deg": anchor.north_deg}
        earth, plan = page.evaluate(
            """async ([anchor, points]) => { const { toEarth, toPlan } = await import('/web/app.js');
            const earth = points.map((point) => toEarth(anchor, point));
            return [earth.map(({ latitude, longitude }) => [longitude, latitude]),
                earth.map((place) => toPlan(anchor, place))]; }""",
            [given, points.tolist()],
        )
        np.testing.assert_allclose(anchor.to_plan(np.array(earth)), points, atol=error_m)
        np.testing.assert_allclose(plan, points, atol=error_m)


@pytest.mark.slow
def test_picture_of_an_answer_is_saved(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path / "data") as client:
        for visited in visit(browser, client):
            page = visited.open_example()
            visited.find()
            # The page has the photograph and the answer: a busy service is not asked.
            page.route("**/localise*", lambda route: route.abort())
            with page.expect_download() as saving:
                page.get_by_role("button", name="Save picture").click()
            assert saving.value.suggested_filename == "lalaloc-kitchen.png"
            saving.value.save_as(tmp_path / "answer.png")
            with Image.open(tmp_path / "answer.png") as picture:
                width, height = picture.size
                colours = picture.convert("RGB").crop((0, 0, width, width // 2)).getcolors(2**24)
            assert width > 900
            # The photograph of 2 : 1, the map and the caption.
            assert height > width
            assert colours is not None
            assert len(colours) > 1000
