"""Drawing and editing plans on the page."""

from __future__ import annotations

import re
from typing import Any

import pytest
from PIL import Image, ImageDraw
from playwright.sync_api import Page, expect

from tests.painted import picture_file
from tests.service.conftest import FLAT, upload
from tests.web.conftest import Visit, choose_plan
from tests.web.test_answer import _assert_accessible


def _click(page: Page, x_m: float, y_m: float) -> None:
    page.mouse.click(*_on_screen(page, x_m, y_m))


def _on_screen(page: Page, x_m: float, y_m: float) -> tuple[float, float]:
    script = """([x, y]) => { const svg = document.getElementById('plan');
        const point = new DOMPoint(x, -y).matrixTransform(svg.getScreenCTM()); return [point.x, point.y]; }"""
    x, y = page.evaluate(script, [x_m, y_m])
    return x, y


def _drag(page: Page, begin: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*_on_screen(page, *begin))
    page.mouse.down()
    page.mouse.move(*_on_screen(page, 0.5 * (begin[0] + end[0]), 0.5 * (begin[1] + end[1])))
    page.mouse.move(*_on_screen(page, *end), steps=3)
    page.mouse.up()


def _enter(page: Page, field: str, value: str) -> None:
    page.locator(field).fill(value)
    page.locator(field).press("Tab")


def _editing(visited: Visit, name: str, **values: Any) -> Page:
    """Store a plan and open the editor on it."""
    upload(visited.client, FLAT | {"name": name} | values)
    page = visited.open()
    expect(page.locator("#plan-name")).to_have_text(name)
    page.get_by_role("button", name="Edit", exact=True).click()
    return page


def test_plan_is_drawn_to_scale_over_a_picture(desktop: Visit) -> None:
    page = desktop.open()
    page.get_by_role("button", name="Draw", exact=True).click()
    picture = Image.new("RGB", (600, 400), "white")
    ImageDraw.Draw(picture).rectangle((100, 100, 400, 300), outline="black", width=4)
    page.locator("#underlay-file").set_input_files(
        {"name": "scan.png", "mimeType": "image/png", "buffer": picture_file(picture)}
    )
    expect(page.get_by_text("Set the scale next")).to_be_attached()
    # Of two points, which are scaled with the plan, the second lies to the right in it and 4.45 m north on Earth.
    _enter(page, "#plan-form-anchor", "0, 0, 48.13722, 11.57569; 6 0 48.13726 11.57569")
    # 600 pixels are 12 m by default, so the rectangle is 6 m wide; its real width is 4.5 m.
    _click(page, 2, 2)
    _click(page, 8, 2)
    page.locator("#known-distance").fill("4.5")
    page.get_by_role("button", name="Set the scale").click()
    assert float(page.locator("#plan image").get_attribute("width") or 0) == pytest.approx(9.0, rel=1e-3)
    page.locator("#tool-room").click()
    for corner in ((1.5, 1.5), (6, 1.5), (6, 4.5), (1.5, 4.5), (1.5, 1.5)):
        _click(page, *corner)
    expect(page.locator("#plan .room")).to_have_count(1)
    page.locator("#room-form-type").select_option("garage")
    _enter(page, "#room-form-name", "Workshop")
    expect(page.locator("#toast")).to_contain_text("The type stays garage")
    for x_m in (3, 3.2):
        page.locator("#tool-door").click()
        _click(page, x_m, 1.5)
    expect(page.locator("#toast")).to_contain_text("door 2 would overlap door 1")
    page.locator("#tool-window").click()
    _click(page, 6, 3)
    _enter(page, "#opening-form-sill", "1.1")
    _assert_accessible(page)
    page.get_by_role("button", name="Store the plan").click()
    expect(page.locator("#toast")).to_contain_text("The picture below it stays until this page is closed.")
    plan = desktop.stored("New plan")["plan"]
    assert (plan["north_deg"], plan["anchor"]["latitude"]) == pytest.approx((90.0, 48.13722))
    (room,) = plan["rooms"]
    assert (room["name"], room["type"]) == ("Workshop", "garage")
    assert sorted(map(tuple, room["polygon"])) == [
        pytest.approx(corner, abs=0.06) for corner in ((1.5, 1.5), (1.5, 4.5), (6, 1.5), (6, 4.5))
    ]
    assert sorted(opening["kind"] for opening in plan["openings"]) == ["door", "window"]
    assert {opening["sill_m"] for opening in plan["openings"] if opening["kind"] == "window"} == {1.1}


def test_dragging_can_be_undone(desktop: Visit) -> None:
    page = _editing(desktop, "Dragged")
    # A value that stays is no change.
    _enter(page, "#plan-form-ceiling", "2.50")
    expect(page.locator("#undo")).to_be_disabled()
    # A wall needs no click on its room before, and undo leaves the room selected.
    _drag(page, (0, 1), (-0.6, 1))
    expect(page.locator("#edit-corner-0")).to_have_attribute("cx", "-0.6")
    page.locator("#undo").click()
    expect(page.locator("#edit-corner-0")).to_have_attribute("cx", "0")
    expect(page.locator("#undo")).to_be_disabled()
    _drag(page, (4, 3), (4.4, 3.4))
    corner = page.locator("#edit-corner-2")
    expect(corner).to_have_attribute(
        "aria-label", r"Corner 3, x 4.40, y 3.40 m. Arrow keys move it, Delete removes it."
    )
    page.keyboard.press("Control+z")
    expect(corner).to_have_attribute("cx", "4")
    expect(page.locator("#undo")).to_be_disabled()
    page.keyboard.press("Control+Shift+z")
    page.get_by_role("button", name="Save as a new revision").dblclick()
    expect(page.locator("#plan-facts")).to_contain_text("revision 2")
    expect(page.locator("#plan-error")).to_be_hidden()
    assert [4.4, 3.4] in [pytest.approx(corner) for corner in desktop.stored("Dragged")["plan"]["rooms"][0]["polygon"]]


@pytest.mark.slow
def test_form_of_the_whole_plan_is_reachable_again(desktop: Visit, phone: Visit) -> None:
    for visited, name in ((desktop, "Whole"), (phone, "Whole on a phone")):
        page = _editing(visited, name, openings=[{"kind": "door", "line": [[4, 1], [4, 2]]}])
        whole = page.locator("#plan-form-north")
        for leave in (
            lambda page=page: page.locator("#whole-plan").click(),
            lambda page=page: page.keyboard.press("Escape"),
            lambda page=page: page.mouse.click(*_on_screen(page, 2, 5)),
        ):
            page.locator("#plan").evaluate("plan => plan.scrollIntoView({block: 'center'})")
            _click(page, 2, 1.5)
            expect(whole).to_have_count(0)
            leave()
            expect(whole).to_be_visible()
        page.locator("#edit-opening-0").focus()
        page.keyboard.press("Enter")
        expect(page.locator("#opening-form-kind")).to_be_visible()
        page.locator("#whole-plan").click()
        expect(whole).to_be_visible()


@pytest.mark.slow
def test_ceiling_of_the_plan_applies_to_all_rooms(desktop: Visit) -> None:
    page = _editing(desktop, "Ceilings")
    expect(page.locator("#plan-form-own-ceilings")).to_contain_text(
        "1 of 2 rooms have ceilings of their own: kitchen 2.40 m"
    )
    for name, value in (("ceiling", "2.7"), ("north", "10"), ("anchor", "48.13722, 11.57569")):
        _enter(page, f"#plan-form-{name}", value)
    page.locator("#one-ceiling").click()
    expect(page.locator("#plan-form-own-ceilings")).to_have_count(0)
    page.locator("#save").click()
    expect(page.locator("#plan-facts")).to_contain_text("revision 2")
    stored = desktop.stored("Ceilings")
    assert [room["ceiling_height_m"] for room in stored["rooms"]] == [2.7, 2.7]
    assert (stored["plan"]["north_deg"], stored["plan"]["anchor"]["longitude"]) == (10.0, 11.57569)


@pytest.mark.slow
def test_drawn_plan_says_that_its_ceiling_is_assumed(desktop: Visit) -> None:
    page = desktop.open()
    page.get_by_role("button", name="Draw", exact=True).click()
    page.locator("#add-room").click()
    _enter(page, "#room-form-name", "Küche")
    page.locator("#whole-plan").click()
    expect(page.locator("#plan-form-ceiling")).to_have_value("")
    _enter(page, "#plan-form-name", "Drawn")
    page.locator("#save").click()
    expect(page.locator("#toast")).to_contain_text("Types of rooms: Küche: kitchen")
    expect(page.locator("#plan-warnings")).to_contain_text("2.5 m is assumed")
    assert desktop.stored("Drawn")["plan"].get("ceiling_height_m") is None


def _skewed_scan() -> bytes:
    """Return a scan of two rooms, turned by 1.5°, at 1 cm per pixel."""
    scan = Image.new("RGB", (900, 700), "white")
    pen = ImageDraw.Draw(scan)
    pen.rectangle((100, 100, 800, 600), outline="black", width=14)
    pen.line((400, 100, 400, 600), fill="black", width=14)
    return picture_file(scan.rotate(1.5, fillcolor="white", resample=Image.Resampling.BICUBIC))


@pytest.mark.slow
def test_picture_of_a_plan_lies_below_it_again(desktop: Visit) -> None:
    file, form = ("Skewed.png", _skewed_scan()), {"metres_per_pixel": "0.01"}
    desktop.client.post("/floorplans", files={"file": file}, data=form).raise_for_status()
    page = desktop.open()
    choose_plan(page, "Skewed")
    page.locator("#edit-plan").click()
    # The picture was straightened, so it is turned to lie below the rooms.
    picture = page.locator("#plan image")
    expect(picture).to_have_attribute("transform", re.compile(r"rotate\(1\.[45]"))
    _enter(page, "#plan-form-name", "Straight")
    page.locator("#save").click()
    expect(page.locator("#plan-facts")).to_contain_text("revision 2")
    # The revision of the editor has no picture of its own.
    page.locator("#edit-plan").click()
    expect(picture).to_have_attribute("transform", re.compile(r"rotate\(1\.[45]"))


@pytest.mark.slow
def test_plan_is_edited_with_the_keyboard_alone(desktop: Visit) -> None:
    page = _editing(desktop, "Typed")
    page.locator("#edit-room-0").focus()
    page.keyboard.press("Enter")
    page.locator("#edit-corner-1").focus()
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowUp")
    expect(page.locator("#edit-corner-1")).to_be_focused()
    expect(page.locator("#edit-corner-1")).to_have_attribute("cx", "4.5")
    page.locator("#edit-wall-2").focus()
    page.keyboard.press("w")
    page.locator("#save").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#plan-facts")).to_contain_text("revision 2")
    plan = desktop.stored("Typed")["plan"]
    assert [4.5, 0.05] in plan["rooms"][0]["polygon"]
    assert [opening["kind"] for opening in plan["openings"]] == ["window"]


def test_plan_changed_by_somebody_else_is_not_overwritten(desktop: Visit) -> None:
    page = _editing(desktop, "Contended")
    _enter(page, "#plan-form-name", "Contended, mine")
    plan_id = desktop.stored("Contended")["id"]
    desktop.client.put(f"/floorplans/{plan_id}", json=FLAT | {"name": "Contended, theirs"}).raise_for_status()
    page.locator("#save").click()
    expect(page.locator("#plan-error")).to_contain_text("Somebody changed this plan")
    assert desktop.stored("Contended")["name"] == "Contended, theirs"
    page.locator("#look-at-theirs").click()
    expect(page.locator("#plan-form-name")).to_have_value("Contended, theirs")
    page.locator("#undo").click()
    expect(page.locator("#plan-form-name")).to_have_value("Contended, mine")
    page.locator("#save").click()
    expect(page.locator("#plan-facts")).to_contain_text("revision 3")
    assert desktop.stored("Contended")["name"] == "Contended, mine"


@pytest.mark.slow
def test_leaving_with_changes_asks_first(desktop: Visit) -> None:
    page = _editing(desktop, "Left")
    # A comma is a decimal point, and the next field keeps the focus.
    page.locator("#plan-form-north").press_sequentially("22,5")
    page.keyboard.press("Tab")
    expect(page.locator("#plan-form-north")).to_have_value("22.5")
    expect(page.locator("#plan-form-anchor")).to_be_focused()
    _enter(page, "#plan-form-ceiling", "-1")
    page.locator("#save").click()
    expect(page.locator("#plan-error")).to_contain_text("“Ceiling” is -1")
    page.locator("#stop").click()
    page.get_by_role("button", name="Continue editing").click()
    expect(page.locator("#save")).to_be_visible()
    page.locator("#stop").click()
    page.get_by_role("button", name="Discard my changes").click()
    expect(page.locator("#save")).to_have_count(0)
    assert desktop.stored("Left")["revision_number"] == 1
