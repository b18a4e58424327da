"""The page that pins a folder of photographs."""

from __future__ import annotations

import io
import itertools
import json
import math
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pypdfium2
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from lalaloc_core.bundle import default_bundle
from tests.service.conftest import StartApp, upload
from tests.strategies import present
from tests.web.conftest import EXAMPLES, Visit, drag, visit
from tests.web.test_answer import _assert_accessible
from tests.web.test_on_device import SLOW_MS, recorded

FLAT = json.loads((EXAMPLES / "flat.json").read_text())
FILES = [EXAMPLES / name for name in ("living_room.jpg", "kitchen.jpg", "bedroom.jpg")]


@pytest.fixture(scope="module")
def service(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Return an app with the shipped model and a plan, as the tiny model gives no features."""
    folder = tmp_path_factory.mktemp("data")
    with start_app(folder, bundle=default_bundle(), request_deadline_s=90.0, sweep_s=0.2) as client:
        upload(client, FLAT | {"name": "Pinned flat"})
        yield client


@pytest.fixture(scope="module")
def grey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a picture that fits anywhere."""
    path = tmp_path_factory.mktemp("pictures") / "grey.jpg"
    Image.effect_noise((320, 240), 20).convert("RGB").save(path)
    return path


def pin_files(visited: Visit, files: list[Path], expected: int | None = None, field: str = "#photo-files") -> Page:
    """Add files to a new album of the shown plan, and wait until it is solved."""
    page = visited.open("/pin")
    expect(page.locator("#plan .room")).to_have_count(len(FLAT["rooms"]))
    page.locator(field).set_input_files(files)
    expect(page.locator(".card")).to_have_count(len(files) if expected is None else expected)
    expect(page.locator("#pin-state")).to_contain_text("(solved)")
    return page


def test_folder_is_pinned_corrected_and_undone(phone: Visit, tmp_path: Path) -> None:
    damaged, other = tmp_path / "damaged.jpg", tmp_path / "notes.txt"
    damaged.write_bytes(b"no picture")
    other.write_text("hello")
    page = pin_files(phone, [*FILES, damaged, other], expected=3)
    expect(page.locator("#problems")).to_contain_text("damaged.jpg: the photograph is not a readable")
    expect(page.locator("#problems")).to_contain_text("left out: 1 (notes.txt)")
    expect(page.locator("#plan .pin")).to_have_count(3)
    expect(page.locator(".card img")).to_have_count(3)
    expect(page.locator(".card", has_text="kitchen.jpg")).to_contain_text(re.compile(r"kitchen, .* %, within 1 m .* %"))
    pin = page.locator("#pin-1")
    before = pin.get_attribute("transform")
    # By keyboard alone: the pin moves, its arrow turns, and both are undone.
    pin.focus()
    page.keyboard.press("ArrowUp")
    expect(pin).to_have_class(re.compile("corrected"))
    expect(pin).not_to_have_attribute("transform", before or "")
    page.get_by_role("button", name="Undo").click()
    expect(pin).not_to_have_class(re.compile("corrected"))
    expect(pin).to_have_attribute("transform", before or "")
    page.get_by_role("button", name="Elsewhere").last.click()
    expect(page.locator("#plan .pin")).to_have_count(2)
    expect(page.locator("#photographs h3", has_text="Set aside (1)")).to_be_visible()
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#plan .pin")).to_have_count(3)
    with page.expect_download() as table:
        page.get_by_role("button", name="CSV").click()
    assert "kitchen.jpg" in Path(table.value.path()).read_text()
    page.locator("#room-filter").select_option(label="kitchen")
    expect(page.locator("#plan .pin")).to_have_count(1)
    assert page.locator(".card").count() == 1
    page.locator("#room-filter").select_option("")
    page.get_by_text("Other places").first.click()
    expect(page.locator("details[open] .choices button").first).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    # The same folder again adds nothing.
    page.locator("#photo-files").set_input_files(FILES)
    expect(page.locator("#problems")).to_contain_text("Photographs that the folder has already: 3")
    expect(page.locator(".card")).to_have_count(3)


@pytest.mark.slow
def test_menu_lists_more_folders_than_a_page_of_the_list_has(desktop: Visit) -> None:
    plan_id = upload(desktop.client, FLAT | {"name": "Visited often"})
    document = {"floorplan_id": plan_id, "name": "One of many"}
    first, *_ = [desktop.client.post("/albums", json=document).json()["id"] for _ in range(105)]
    page = desktop.open("/pin#album=gone")
    expect(page.locator("#pin-error")).to_contain_text("folder 'gone' does not exist")
    expect(page.locator("#plan-choice option", has_text="One of many")).to_have_count(105)
    page.locator("#plan-choice").select_option(f"album:{first}")
    expect(page.locator("#pin-state")).to_contain_text("0 of 0 photographs")
    desktop.client.delete(f"/floorplans/{plan_id}")


@pytest.mark.slow
def test_uncertain_photographs_are_decided_by_keys_and_printed(desktop: Visit, grey: Path) -> None:
    page = pin_files(desktop, [grey, *FILES])
    _assert_accessible(page)
    card = page.locator(".card", has_text="grey.jpg")
    if card.locator(".choices").count() == 0:
        pytest.fail("the picture without content is pinned for sure")
    suggestion = card.locator(".choices button").nth(1).get_attribute("aria-label") or ""
    room = suggestion.removeprefix("2: ").rpartition(",")[0]
    card.focus()
    page.keyboard.press("2")
    expect(card).to_contain_text(f"{room}, corrected")
    # Nothing is left to check, so the focus is on the way back.
    expect(page.get_by_role("button", name="Undo")).to_be_focused()
    page.keyboard.press("Control+z")
    expect(card).not_to_contain_text("corrected")
    card.focus()
    page.keyboard.press("0")
    expect(page.locator("#photographs h3", has_text="Set aside (1)")).to_be_visible()
    kitchen = page.locator(".card", has_text="kitchen.jpg")
    kitchen.focus()
    page.keyboard.press("Enter")
    expect(kitchen).to_contain_text("kitchen, corrected")
    document = pypdfium2.PdfDocument(io.BytesIO(page.pdf(format="A4")))
    texts = [sheet.get_textpage().get_text_range().split("\r\n") for sheet in document]
    assert (texts[0][0], texts[-1][0]) == ("Pinned flat", "Set aside")
    assert {text[0] for text in texts[1:-1]} == {"living room", "kitchen", "bedroom"}
    assert any("kitchen.jpg" in line for text in texts for line in text if text[0] == "kitchen")


@pytest.mark.slow
def test_arrow_is_turned_and_pin_is_dragged(desktop: Visit) -> None:
    page = pin_files(desktop, [FILES[1]])
    pin = page.locator("#pin-1")
    circle = present(pin.locator("circle").bounding_box())
    before = pin.locator(".arrow").get_attribute("transform") or ""
    heading, reach = math.radians(float(re.findall(r"[\d.]+", before)[0])), 0.8 * circle["width"]
    centre = circle["x"] + circle["width"] / 2, circle["y"] + circle["height"] / 2
    # From the tip to the north.
    tip = centre[0] + reach * math.sin(heading), centre[1] - reach * math.cos(heading)
    drag(page, tip, (centre[0], centre[1] - 60))
    expect(pin).to_have_class(re.compile("corrected"))
    turned = pin.locator(".arrow").get_attribute("transform") or ""
    assert turned != before
    angle = float(re.findall(r"[\d.]+", turned)[0])
    assert min(angle, 360.0 - angle) < 3.0
    place = pin.get_attribute("transform") or ""
    drag(page, centre, (centre[0] + 40, centre[1] + 20))
    expect(pin).not_to_have_attribute("transform", place)
    expect(page.locator("#pin-state")).to_contain_text("(solved)")
    moved = present(pin.locator("circle").bounding_box())
    assert moved["x"] == pytest.approx(circle["x"] + 40, abs=6)
    expect(pin.locator(".arrow")).to_have_attribute("transform", turned)
    # Outside of all rooms the pin goes back. The service rounds places, before or after the page is asked.
    place = re.sub(r"(\.\d)\d*", r"\1", pin.get_attribute("transform") or "")
    decimals = re.escape(place).replace(r"\ ", r"\d* ").replace(r"\)", r"\d*\)")
    drag(page, (centre[0] + 40, centre[1] + 20), (5, 5))
    expect(page.locator("#pin-error")).to_contain_text("lies in no room")
    expect(pin).to_have_attribute("transform", re.compile(f"^{decimals}$"))


@pytest.mark.slow
def test_photographs_wait_for_a_plan(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    settings = {"request_deadline_s": 90.0, "sweep_s": 0.2, "max_album_photographs": 2}
    with start_app(tmp_path, bundle=default_bundle(), **settings) as client:
        for visited in visit(browser, client, color_scheme="dark", reduced_motion="reduce"):
            page = visited.open("/pin")
            page.locator("#photo-files").set_input_files(FILES[:2])
            expect(page.locator("#pin-state")).to_contain_text("2 photographs wait for it")
            _assert_accessible(page)
            page.locator("#plan-file").set_input_files(EXAMPLES / "flat.json")
            expect(page.locator("#pin-state")).to_contain_text("(solved)")
            expect(page.locator("#plan .pin")).to_have_count(2)
            _assert_accessible(page)
            # The page can be loaded again; previews have stayed in the page before.
            page.reload()
            expect(page.locator("#plan .pin")).to_have_count(2)
            expect(page.locator(".shot.none")).to_have_count(2)
            # While another plan is uploaded, photographs wait for that, not for the one that is shown.
            page.locator("#plan-file").set_input_files(EXAMPLES / "real" / "rooms.json")
            page.locator("#photo-files").set_input_files(EXAMPLES / "real" / "hotel_room.jpg")
            expect(page.locator("#pin-state")).to_contain_text("of 1 photographs pinned for sure (solved)")
            album, plan = client.get("/albums").json()["albums"][0], client.get("/floorplans").json()["floorplans"][0]
            assert plan["name"] == "Six photographed rooms"
            assert album["floorplan_id"] == plan["id"]
            page.locator("#photo-files").set_input_files(FILES[:2])
            expect(page.locator("#problems")).to_contain_text("A folder has at most 2 photographs; left out: 1.")
            # The folder before is listed with its date.
            saved = page.locator("#plan-choice optgroup[label='Saved folders'] option")
            names = "Six photographed rooms", "Example flat"
            expect(saved).to_have_text([re.compile(rf"\d{{4}}, [\d:]{{5}}, {name}$") for name in names])
            page.locator("#plan-choice").select_option(saved.last.get_attribute("value"))
            expect(page.locator("#plan .room")).to_have_count(len(FLAT["rooms"]))
            expect(page.locator("#plan .pin")).to_have_count(2)


@pytest.mark.slow
def test_album_of_a_venue_shows_the_plan_of_each_pin(desktop: Visit) -> None:
    rooms = [{**room, "polygon": [[x, y / 2] for x, y in room["polygon"]]} for room in FLAT["rooms"]]
    squeezed = {key: value for key, value in FLAT.items() if key in ("ceiling_height_m", "camera_height_m")}
    upper = upload(desktop.client, squeezed | {"name": "Upper", "rooms": rooms})
    lower = upload(desktop.client, FLAT | {"name": "Lower"})
    plans = [{"floorplan_id": upper, "level": 1}, {"floorplan_id": lower, "level": 0}]
    venue = desktop.client.post("/venues", json={"name": "House", "plans": plans}).json()
    page = desktop.open("/pin")
    page.locator("#plan-choice").select_option(f"venue:{venue['id']}")
    expect(page.locator("#level-choice option")).to_have_count(2)
    page.locator("#photo-files").set_input_files(FILES[1])
    expect(page.locator("#pin-state")).to_contain_text("(solved)")
    page.locator("#level-choice").select_option(upper)
    expect(page.locator("#plan .pin")).to_have_count(0)
    page.locator(".card").focus()
    expect(page.locator("#level-choice")).to_have_value(lower)
    expect(page.locator("#plan .pin.current")).to_have_count(1)
    desktop.client.delete(f"/venues/{venue['id']}")
    for plan_id in (upper, lower):
        desktop.client.delete(f"/floorplans/{plan_id}")


@pytest.mark.slow
def test_venue_that_is_chosen_while_the_first_plan_loads_stays(desktop: Visit) -> None:
    plan_id = upload(desktop.client, FLAT | {"name": "Slow"})
    plans = [{"floorplan_id": plan_id, "level": 0}]
    venue = desktop.client.post("/venues", json={"name": "House", "plans": plans}).json()
    held = list[Route]()
    # The page loads the newest plan at first.
    desktop.page.route(f"**/floorplans/{plan_id}", lambda route: route.continue_() if held else held.append(route))
    page = desktop.open("/pin")
    page.locator("#plan-choice").select_option(f"venue:{venue['id']}")
    expect(page.locator("#level-choice option")).to_have_count(1)
    expect(page.locator("#level-choice")).to_be_visible()
    (first,) = held
    with page.expect_response(f"**/floorplans/{plan_id}"):
        first.continue_()
    expect(page.locator("#plan .room")).to_have_count(len(FLAT["rooms"]))
    expect(page.locator("#level-choice")).to_be_visible()
    desktop.page.unroute_all()
    desktop.client.delete(f"/venues/{venue['id']}")
    desktop.client.delete(f"/floorplans/{plan_id}")


@pytest.mark.slow
def test_photographs_stay_on_the_device(browser: Browser, service: httpx.Client) -> None:
    with recorded(service) as (wire, through):
        for visited in visit(browser, through):
            page = visited.open("/pin")
            expect(page.locator("#plan .room")).to_have_count(len(FLAT["rooms"]))
            page.get_by_label("Keep these photographs on my device").check()
            page.locator("#photo-files").set_input_files(FILES[1])
            expect(page.locator("#pin-state")).to_contain_text("(solved)", timeout=SLOW_MS)
            expect(page.locator(".card")).to_contain_text("kitchen.jpg")
            expect(page.locator(".card")).to_contain_text("kitchen, ")
        assert len(wire.bodies()) == 1
        assert FILES[1].read_bytes()[1000:2000] not in bytes(wire.sent)


@pytest.mark.slow
def test_changed_plan_lists_what_moved(desktop: Visit) -> None:
    plan_id = upload(desktop.client, FLAT | {"name": "Changing"})
    page = pin_files(desktop, FILES[1:2])
    rooms = [{**room, "polygon": [[x + 5, y] for x, y in room["polygon"]]} for room in FLAT["rooms"]]
    doors = [{**opening, "line": [[x + 5, y] for x, y in opening["line"]]} for opening in FLAT["openings"]]
    desktop.client.put(f"/floorplans/{plan_id}", json={**FLAT, "rooms": rooms, "openings": doors}).raise_for_status()
    # The page looks when it is seen again.
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#moved-list li")).to_have_text(re.compile(r"1 kitchen.jpg: kitchen, 5\.\d m away"))
    desktop.client.delete(f"/floorplans/{plan_id}")


@pytest.mark.slow
def test_pins_do_not_cover_each_other_nor_walls_the_bars_of_a_screenshot(desktop: Visit, tmp_path: Path) -> None:
    barred, again = EXAMPLES.parent / "tests/core/faults/screenshot_bars.jpg", tmp_path / "again.jpg"
    Image.open(barred).save(again)
    page = pin_files(desktop, [*FILES, again, barred])
    expect(page.locator("#album-warnings")).to_contain_text("1 again.jpg and 1 more: the photograph is within bars")
    drawn = page.locator(".card", has_text="bars").locator(".shot path").last.get_attribute("d") or ""
    # The photograph is the middle 808 of 2,340 rows, drawn 400 pixels wide for 1,080.
    offsets = [abs(float(y) * 1080 / 400 - 1170) for y in re.findall(r"[ML]\S+ ([\d.]+)", drawn)]
    assert 300 < max(offsets) < 404 + 3
    path = f"/albums/{page.url.partition('#album=')[2]}/photographs"
    # Each is nearer to the next than a pin is wide, two are on one spot.
    for index, photograph in enumerate(desktop.client.get(path).json()["photographs"]):
        correction = {"position": {"x_m": 6.5 + 0.12 * max(index, 1), "y_m": 2.0}}
        desktop.client.patch(f"{path}/{photograph['id']}", json={"correction": correction}).raise_for_status()
    page.reload()
    expect(page.locator("#plan .pin.corrected")).to_have_count(5)
    circles = [present(page.locator(f"#pin-{number} circle").bounding_box()) for number in range(1, 6)]
    for first, second in itertools.combinations(circles, 2):
        assert math.dist((first["x"], first["y"]), (second["x"], second["y"])) > 0.95 * first["width"]


@pytest.mark.slow
def test_copies_are_downloaded_while_the_page_has_the_files(desktop: Visit, tmp_path: Path) -> None:
    # One is in a folder within the folder.
    (tmp_path / "inner").mkdir()
    for file, folder in zip(FILES[:2], (tmp_path, tmp_path / "inner"), strict=True):
        shutil.copy(file, folder)
    page = pin_files(desktop, [tmp_path], expected=2, field="#photo-folder")
    copies = page.get_by_role("button", name="Copies with their place, and a report")
    with page.expect_download() as archive:
        copies.click()
    names = zipfile.ZipFile(archive.value.path()).namelist()
    assert names == ["photographs/kitchen.jpg", "photographs/living_room.jpg", "report.pdf"]
    page.reload()
    copies.click()
    expect(page.locator("#pin-error")).to_contain_text("This page has no file of 2 photographs")
    page.locator("#photo-files").set_input_files(FILES[:2])
    expect(page.locator("#problems")).to_contain_text("the folder has already: 2")
    with page.expect_download():
        copies.click()
