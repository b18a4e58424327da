"""Photographs that are no full spheres, on the page."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from PIL import ExifTags, Image
from playwright.sync_api import Page, Route, expect

from lalaloc_core.photograph.cameras import Perspective
from tests.core.fault_photographs import FAULTS, FOLDER, Fault, fault_id
from tests.core.taken import EXAMPLES, jpeg, sphere, take
from tests.web.conftest import Visit

APP_SETTINGS = {"bundle": "tiny_view_bundle"}


def test_phone_photograph_shows_its_layout_in_perspective(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open_example()
    camera = Perspective.of_hfov(640, 480, math.radians(67.3))
    picture = jpeg(take(sphere("living_room"), camera), {ExifTags.Base.FocalLengthIn35mmFilm: 26})
    (tmp_path / "phone.jpg").write_bytes(picture)
    page.locator("#photo-file").set_input_files(tmp_path / "phone.jpg")
    expect(page.locator(".stage")).to_have_attribute("data-shape", "flat")
    # The untrained model is led to a place that sees more than one window.
    page.locator("#heading").evaluate("field => field.closest('details').open = true")
    page.locator("#heading").fill("180")
    desktop.find()
    expect(page.locator("#answer-body .assumed").last).to_contain_text(
        re.compile(r"Read as an ordinary photograph, 67° ± \d° wide \(from the file\), tilted up by .* \(.+\)\.")
    )
    expect(page.locator("#answer-body .advice")).to_contain_text("choose “Taken from one spot, turning”")
    # The overlay is drawn on the photograph, which the stage contains, and nowhere beside it.
    beside, on = page.evaluate(
        """() => { const canvas = document.querySelector('canvas.overlay');
        const { width, height } = canvas, shown = height * 4 / 3, left = (width - shown) / 2;
        const pixels = canvas.getContext('2d').getImageData(0, 0, width, height).data;
        const count = [0, 0];
        for (let i = 0; i < width * height; i++)
            if (pixels[4 * i + 3] > 0)
                count[Number(i % width >= left - 4 && i % width <= left + shown + 4)]++;
        return count; }"""
    )
    assert beside == 0
    assert on > 100
    page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
    expect(page.locator(".stage")).to_have_attribute("data-shape", "around")
    page.locator("#photo-file").set_input_files(FOLDER / "sphere_orientation6.jpg")
    desktop.find()
    expect(page.locator(".stage.stored")).to_have_attribute("data-shape", "whole")
    expect(page.locator("img.whole")).to_have_css("image-orientation", "none")


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=fault_id)
def test_photograph_with_a_fault_is_shown_and_what_is_said_about_it(desktop: Visit, fault: Fault) -> None:
    page = desktop.open_example()
    page.locator("#photo-file").set_input_files(FOLDER / fault.name)
    expect(page.locator("#photo-strip li")).to_have_count(1)
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#answer" if fault.is_usable else "#photo-error")).to_be_visible()
    # The page has no fields for intrinsics.
    if fault.said is not None and "intrinsics" not in fault.fields:
        place = page.locator("#answer-body .warning" if fault.is_usable else "#photo-error")
        expect(place.filter(has_text=fault.said.replace("hfov_deg", "“Field of view”"))).to_be_visible()


def test_photographs_are_in_the_order_of_their_times(desktop: Visit, tmp_path: Path) -> None:
    for name, minute in (("1.jpg", 2), ("2.jpg", 1)):
        time = {ExifTags.Base.DateTimeOriginal: f"2026:05:01 10:{minute:02}:00"}
        (tmp_path / name).write_bytes(jpeg(sphere("study")[:480, :640], time))
    (tmp_path / "cut.jpg").write_bytes((EXAMPLES / "kitchen.jpg").read_bytes()[:30_000])
    (tmp_path / "none.heic").write_bytes(b"no picture")
    page, chosen = desktop.open_example(), desktop.page.locator("#photo-file")
    chosen.set_input_files([tmp_path / "1.jpg", tmp_path / "2.jpg"])
    expect(page.locator(".thumb span")).to_have_text(["2.jpg", "1.jpg"])
    chosen.set_input_files(tmp_path / "none.heic")
    expect(page.locator("#photo-error")).to_contain_text("cannot show “none.heic” as a picture")
    expect(page.locator(".thumb img")).to_have_count(2)
    chosen.set_input_files(tmp_path / "cut.jpg")
    expect(page.locator(".stage")).to_have_attribute("data-shape", "around")


def _colours(page: Page, place: str) -> list[list[int]]:
    """Return the colour in the middle of each picture in a part of the map."""
    return page.evaluate(
        """async (place) => { const colours = [];
        for (const image of document.querySelectorAll(place + ' image')) {
            const shown = new Image(); shown.src = image.getAttribute('href'); await shown.decode();
            const canvas = document.createElement('canvas');
            [canvas.width, canvas.height] = [shown.width, shown.height];
            const context = canvas.getContext('2d'); context.drawImage(shown, 0, 0);
            colours.push([...context.getImageData(shown.width >> 1, shown.height >> 1, 1, 1).data]);
        }
        return colours; }""",
        place,
    )


@pytest.mark.slow
def test_layer_shows_where_photographs_will_be_found(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open_example()
    opener = page.get_by_role("button", name="Will it work here?")
    held = list[Route]()
    page.route("**/localisability", lambda route: held.append(route))
    opener.click()
    panel = page.get_by_role("region", name="Will it work here?")
    expect(panel.locator("#localisability-progress")).to_contain_text("Step 1 of 2")
    # A rough map is shown while the full prediction is under way.
    expect(panel.locator("#localisability-progress")).to_contain_text("Step 2 of 2", timeout=100_000)
    assert len(_colours(page, "#plan .localisability")) == 7
    expect(panel.locator("li", has_text="are found instead of")).to_have_count(0)
    (route,) = held
    route.continue_()
    expect(panel.locator("#localisability-progress")).to_be_hidden(timeout=100_000)
    expect(opener).to_have_attribute("aria-pressed", "true")
    expect(panel).to_contain_text("heading")
    expect(panel.locator(".share")).to_contain_text("within 1 m")
    phone = _colours(page, "#plan .localisability")
    assert len(phone) == 7
    panel.get_by_label("Probability of finding").select_option("a 360° photograph")
    panel.get_by_label("heading known").check()
    assert _colours(page, "#plan .localisability") != phone
    with page.expect_download() as saving:
        page.get_by_role("button", name="Save map").click()
    assert saving.value.suggested_filename == "Example flat.png"
    saving.value.save_as(tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as picture:
        assert max(picture.size) == 2400
        # Walls, floors of other shades, and names.
        assert len(picture.convert("RGB").resize((60, 60)).getcolors(3600) or []) > 50
    # The answer takes its place.
    desktop.find()
    expect(panel).to_be_hidden()
    assert _colours(page, "#plan .localisability") == []


def _phone_photographs(folder: Path, headings_deg: list[float]) -> list[Path]:
    """Write photographs of a phone that turns on one spot of the example flat."""
    camera = Perspective.of_hfov(640, 480, math.radians(67.3))
    paths = [folder / f"turned_{heading_deg:g}.jpg" for heading_deg in headings_deg]
    for path, heading_deg in zip(paths, headings_deg, strict=True):
        pixels = take(sphere("living_room"), camera, heading_deg=heading_deg)
        path.write_bytes(jpeg(pixels, {ExifTags.Base.FocalLengthIn35mmFilm: 26}))
    return paths


@pytest.mark.slow
def test_photographs_of_one_spot_are_one_query(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    # The page begins with a turn of a phone.
    with page.expect_response("**/localise/sequence") as received:
        desktop.find()
    assert len(received.value.json()["poses"]) == 4
    expect(page.locator(".stage")).to_have_attribute("data-shape", "flat")
    page.locator("#photo-file").set_input_files(_phone_photographs(tmp_path, [0.0, 60.0, 120.0]))
    # Photographs of the example give way to the user's own.
    expect(page.locator("#photo-strip li")).to_have_count(3)
    together = page.get_by_role("group", name="These photographs are")
    expect(together.get_by_label("Each by itself")).to_be_checked()
    together.get_by_label("Taken from one spot, turning").check()
    expect(page.get_by_role("button", name="Find all")).to_be_hidden()
    with page.expect_response("**/localise/sequence") as received:
        desktop.find()
    assert len(received.value.json()["poses"]) == 3
    expect(page.locator("#answer-body")).to_contain_text("From 3 photographs together")
    expect(page.locator(".thumb span", has_text="✓")).to_have_count(3)
    # The other two photographs are on the plan, and a click shows their answer.
    expect(page.locator("#plan .companion")).to_have_count(2)
    page.locator(".thumb").nth(2).click()
    expect(page.locator("#answer-body")).to_contain_text("From 3 photographs together")
    page.locator("#copy-curl").click()
    copied = page.locator("#copied").inner_text()
    assert "/localise/sequence" in copied
    assert "motion=turn" in copied
    assert copied.count("photo=@turned_") == 3
    # A change for one photograph makes the common answer invalid.
    page.get_by_text("Heading and hints").click()
    page.locator("#heading").fill("40")
    expect(page.locator("#answer")).to_be_hidden()
    expect(page.locator(".thumb span", has_text="✓")).to_have_count(0)
    desktop.find()
    page.locator("#copy-python").click()
    expect(page.locator("#copied")).to_contain_text("headings_deg=[None,None,40]")


@pytest.mark.slow
def test_statements_about_the_camera_are_sent(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open_example()
    (photograph,) = _phone_photographs(tmp_path, [0.0])
    page.locator("#photo-file").set_input_files(photograph)
    expect(page.get_by_label("Field of view, °")).to_be_hidden()
    page.get_by_text("More about this photograph").click()
    page.get_by_label("Kind").select_option("ordinary photograph")
    page.get_by_label("Field of view, °").fill("70")
    page.get_by_label("Tilted up by, °").fill("-3")
    desktop.find()
    words = page.locator("#answer-body .assumed").last
    expect(words).to_contain_text(re.compile(r"70°.* wide \(as entered\), tilted down by 3° ± 1°"))
    page.get_by_text("Heading and hints").click()
    page.get_by_label("Field of view, °").fill("400")
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#photo-error")).to_contain_text("“Field of view”")
    expect(page.locator("#photo-error")).not_to_contain_text("hfov_deg")
