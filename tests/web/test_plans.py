"""Plans on the start page: upload, search, deletion, progress and API keys; API documentation."""

from __future__ import annotations

import json
import re
from datetime import timedelta
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from PIL import Image, ImageDraw
from playwright.sync_api import Browser, Page, Route, expect

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import export_plan
from service.security.keys import hash_of, key_text, new_secret
from service.storage.store import Store
from tests.importers.test_crop import SCALE, _storeys
from tests.importers.test_lettering import AREAS_M2, PrintedPlan
from tests.importers.test_pictures import open_hall
from tests.painted import picture_file
from tests.service.conftest import FLAT, DatabaseOf, StartApp, upload
from tests.service.test_security import EVERYTHING, make_key
from tests.strategies import present
from tests.web.conftest import EXAMPLES, Visit, choose_plan, drag, visit
from tests.web.test_answer import _assert_accessible


def _overlapping() -> dict[str, object]:
    rooms = [{"name": "hall", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]]}]
    rooms.append({"name": "den", "polygon": [[3, 0], [7, 0], [7, 3], [3, 3]]})
    return {"name": "Overlap", "ceiling_height_m": 2.5, "rooms": rooms}


def test_uploaded_plan_is_drawn_with_its_warnings(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    (tmp_path / "overlap.json").write_text(json.dumps(_overlapping()))
    page.locator("#plan-file").set_input_files(tmp_path / "overlap.json")
    expect(page.locator("#plan-name")).to_have_text("Overlap")
    expect(page.locator("#plan .room")).to_have_count(2)
    expect(page.locator("#plan-warnings")).to_contain_text("overlap")


@pytest.mark.slow
def test_areas_without_a_room_are_marked(phone: Visit) -> None:
    file, form = ("Open hall.png", open_hall()), {"metres_per_pixel": "0.01"}
    phone.client.post("/floorplans", files={"file": file}, data=form).raise_for_status()
    page = phone.open()
    choose_plan(page, "Open hall")
    area, view = (present(page.locator(name).bounding_box()) for name in (".no-room", "#plan"))
    assert view["x"] < area["x"] < area["x"] + area["width"] < view["x"] + view["width"]
    expect(page.locator("#plan .name", has_text="no room")).to_have_count(1)
    expect(page.locator("#plan-warnings")).to_contain_text("set “Ceiling”")
    page.locator("#edit-plan").click()
    expect(page.locator(".no-room")).to_have_count(0)
    # The editor shows the picture where the room was lost, to x = 9.8 m.
    expect(page.locator("#plan image")).to_be_visible()
    script = """() => { const svg = document.getElementById('plan'), box = svg.getBoundingClientRect();
        return new DOMPoint(9.8, -2.5).matrixTransform(svg.getScreenCTM()).x - box.right; }"""
    assert page.evaluate(script) < 0.0


@pytest.mark.slow
def test_compass_does_not_cover_the_words_without_a_photograph(phone: Visit) -> None:
    upload(phone.client, FLAT | {"name": "Without a photograph"})
    page = phone.open()
    choose_plan(page, "Without a photograph")
    expect(page.locator("#photo-none")).to_be_visible()
    script = """() => { const words = document.createRange();
        words.selectNodeContents(document.getElementById('photo-none'));
        const { bottom } = document.querySelector('.compass').getBoundingClientRect();
        return words.getBoundingClientRect().top - bottom; }"""
    assert page.evaluate(script) >= 0.0


@pytest.mark.slow
def test_late_example_does_not_replace_an_upload(desktop: Visit, tmp_path: Path) -> None:
    (tmp_path / "overlap.json").write_text(json.dumps(_overlapping() | {"name": "Early"}))
    page, held = desktop.page, list[Route]()
    page.route("**/web/example-flat.json", lambda route: held.append(route))
    with page.expect_request("**/web/example-flat.json"):
        desktop.open()
    page.locator("#plan-file").set_input_files(tmp_path / "overlap.json")
    expect(page.locator("#plan-name")).to_have_text("Early")
    (route,) = held
    with page.expect_response("**/web/example-flat.json"):
        route.continue_()
    page.wait_for_load_state("networkidle")
    expect(page.locator("#plan-name")).to_have_text("Early")
    expect(page.locator("#photo-strip li")).to_have_count(0)


def _scan() -> Image.Image:
    """Draw two rooms with a door without a swing between them, 7 by 5 m at 1 cm per pixel."""
    scan = Image.new("RGB", (900, 700), "white")
    pen = ImageDraw.Draw(scan)
    pen.rectangle((100, 100, 800, 600), outline="black", width=14)
    pen.line((400, 100, 400, 600), fill="black", width=14)
    pen.rectangle((394, 300, 407, 390), fill="white", outline="black", width=2)
    return scan


def _on_screen(page: Page, x: float, y: float) -> tuple[float, float]:
    """Return the place of a pixel of the picture that is measured."""
    script = """([x, y]) => { const point = new DOMPoint(x, y).matrixTransform(
        document.querySelector('svg.picture').getScreenCTM()); return [point.x, point.y]; }"""
    return page.evaluate(script, [x, y])


def _drag_end(page: Page, index: int, x: float, y: float) -> None:
    """Move an end of the line that measures a picture to a pixel."""
    end = present(page.locator(".measured circle").nth(index).bounding_box())
    drag(page, (end["x"] + end["width"] / 2, end["y"] + end["height"] / 2), _on_screen(page, x, y))


@pytest.mark.slow
def test_imported_picture_is_scaled_and_corrected(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    _scan().save(tmp_path / "scan.png")
    page.locator("#plan-file").set_input_files(tmp_path / "scan.png")
    page.get_by_role("button", name="Read the picture").click()
    # The missing distance is an error of its field.
    expect(page.locator("#picture-metres-error")).to_contain_text("enter their distance in metres")
    expect(page.get_by_label("Distance of the ends in metres")).to_be_focused()
    expect(page.locator("#plan-error")).to_be_hidden()
    # Between the centre lines of the outer walls: 6.86 m.
    _drag_end(page, 0, 107, 350)
    _drag_end(page, 1, 793, 350)
    _assert_accessible(page)
    page.get_by_label("Distance of the ends in metres").fill("6.86")
    page.get_by_role("button", name="Read the picture").click()
    expect(page.locator("#plan-warnings")).to_contain_text("draft")
    expect(page.locator("#plan-facts")).to_contain_text("2 rooms, 31.")
    page.get_by_role("button", name="Edit", exact=True).click()
    # The picture lies under the plan to scale.
    picture = page.locator("#plan image")
    expect(picture).to_have_count(1)
    assert float(picture.get_attribute("width") or 0) == pytest.approx(9.0, rel=0.01)
    doors = page.locator("#plan-form-all-door")
    expect(doors).not_to_be_checked()
    doors.check()
    page.get_by_role("button", name="Save as a new revision").click()
    expect(page.locator("#plan-facts")).to_contain_text("revision 2")
    plan = desktop.stored("scan")["plan"]
    assert plan["opening_kinds"] == ["door"]
    assert [opening["kind"] for opening in plan["openings"]] == ["door"]


@pytest.mark.slow
def test_printed_dimensions_give_the_scale_of_a_picture(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    (tmp_path / "printed.png").write_bytes(PrintedPlan().file())
    page.locator("#plan-file").set_input_files(tmp_path / "printed.png")
    page.get_by_role("button", name="Read the picture").click()
    expect(page.locator("#plan-facts")).to_contain_text(re.compile(r"3 rooms, 5[012]\."), timeout=120_000)
    expect(page.locator("#picture-metres-error")).to_be_hidden()
    assert {room["name"] for room in desktop.stored("printed")["plan"]["rooms"]} == set(AREAS_M2)


def test_all_levels_of_a_picture_replace_the_draft_of_one(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    (tmp_path / "House.png").write_bytes(picture_file(_storeys()))
    page.locator("#plan-file").set_input_files(tmp_path / "House.png")
    page.get_by_text("Other ways to state the scale").click()
    page.get_by_label("Metres per pixel").fill(str(SCALE))
    page.get_by_role("button", name="Read the picture").click()
    expect(page.locator("#plan-name")).to_have_text("House – Storey 1", timeout=120_000)
    page.get_by_role("button", name="Import all levels as a venue").click()
    expect(page.locator("#venue-bar")).to_contain_text("2 plans", timeout=120_000)
    listed = desktop.client.get("/floorplans?name=House").json()["floorplans"]
    assert sorted(plan["name"] for plan in listed) == ["House – Storey 1", "House – Storey 2"]


def test_files_of_other_tools_are_imported(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    (tmp_path / "flat.dxf").write_bytes(export_plan(FloorPlan.from_dict(FLAT), "dxf"))
    page.locator("#plan-file").set_input_files(tmp_path / "flat.dxf")
    expect(page.locator("#plan-facts")).to_contain_text("2 rooms, 36.0 m²")
    name = page.locator("#plan-name").inner_text()
    (tmp_path / "letter.txt").write_text("Dear landlord")
    page.locator("#plan-file").set_input_files(tmp_path / "letter.txt")
    expect(page.locator("#plan-error")).to_be_visible()
    # The plan before stays; no option would make a plan of a text.
    expect(page.locator("#plan .room")).to_have_count(2)
    expect(page.locator("#plan-name")).to_have_text(name)
    expect(page.locator("#import-form")).to_be_empty()
    # The error goes with the next thing that works.
    page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
    expect(page.locator("#plan-error")).to_be_hidden()


@pytest.mark.slow
def test_huge_picture_is_refused_before_its_scale_is_asked(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    Image.new("1", (8000, 5001), 1).save(tmp_path / "huge.png")
    page.locator("#plan-file").set_input_files(tmp_path / "huge.png")
    expect(page.locator("#plan-error")).to_contain_text("8000 × 5001 = 40008000 pixels; the limit is 40000000")
    expect(page.locator("#plan-error")).to_contain_text("Make it smaller, to 99 % of its width.")
    expect(page.locator("#import-form")).to_be_empty()
    _scan().save(tmp_path / "scan.png")
    page.locator("#plan-file").set_input_files(tmp_path / "scan.png")
    expect(page.locator("#import-form")).to_contain_text("Set the scale")
    expect(page.locator("#plan-error")).to_be_hidden()


def test_rejected_plan_is_not_shown(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    expect(page.locator("#plan .room").first).to_be_visible()
    rooms = page.locator("#plan .room").count()
    crossing = {"rooms": [{"name": "bow", "polygon": [[0, 0], [4, 3], [4, 0], [0, 3]], "ceiling_height_m": 2.5}]}
    (tmp_path / "bow.json").write_text(json.dumps(crossing))
    page.locator("#plan-file").set_input_files(tmp_path / "bow.json")
    expect(page.locator("#plan-error")).to_contain_text("bow")
    # The form imports the same file again with other options.
    page.get_by_role("textbox", name="Level").fill("")
    with page.expect_request(lambda request: request.method == "POST" and request.url.endswith("/floorplans")):
        page.get_by_role("button", name="Import again").click()
    expect(page.locator("#plan-error")).to_contain_text("bow")
    expect(page.locator("#plan .room")).to_have_count(rooms)


@pytest.mark.slow
def test_plans_menu_closes(desktop: Visit) -> None:
    upload(desktop.client, FLAT | {"name": "Closing"})
    page = desktop.open()
    opener, entries = page.get_by_text("Plans", exact=True), page.locator("#plan-list")
    opener.click()
    expect(entries).to_be_visible()
    page.keyboard.press("Escape")
    expect(entries).to_be_hidden()
    opener.click()
    page.locator("#photo-title").click()
    expect(entries).to_be_hidden()
    choose_plan(page, "Closing")


@pytest.mark.slow
def test_levels_of_a_file_are_a_list(desktop: Visit, tmp_path: Path) -> None:
    collection = json.loads(export_plan(FloorPlan.from_dict(FLAT), "geojson"))
    floors = [json.loads(json.dumps(collection["features"])) for _ in range(2)]
    for level, features in enumerate(floors):
        for feature in features:
            feature["properties"]["level"] = str(level)
            feature.pop("id", None)
    # One room is missing upstairs.
    rooms = [feature for feature in floors[1] if feature["geometry"]["type"] == "Polygon"]
    floors[1].remove(rooms[0])
    collection["features"] = [*floors[0], *floors[1]]
    (tmp_path / "house.geojson").write_text(json.dumps(collection))
    page = desktop.open()
    page.locator("#plan-file").set_input_files(tmp_path / "house.geojson")
    form = page.locator("#import-form")
    expect(form).to_contain_text("has 2 levels: choose one, or import all")
    expect(page.locator("#plan-error")).to_be_hidden()
    _assert_accessible(page)
    form.get_by_role("button", name="1", exact=True).click()
    expect(page.locator("#plan-facts")).to_contain_text(f"{len(rooms) - 1} room")
    page.locator("#plan-file").set_input_files(tmp_path / "house.geojson")
    form.get_by_role("button", name="Import all levels as a venue").click()
    expect(page.locator("#venue-bar")).to_contain_text("2 plans")
    expect(form).to_be_empty()
    expect(page.locator("#venue-plan option")).to_have_count(2)
    # An import that ends while the user edits a plan changes neither the plan nor what is left to choose.
    page.locator("#plan-file").set_input_files(tmp_path / "house.geojson")
    held = list[Route]()
    page.route("**/venues", lambda route: held.append(route))
    form.get_by_role("button", name="Import all levels as a venue").click()
    expect(page.locator("#plan-state")).to_contain_text("Importing all")
    name = page.locator("#plan-name").inner_text()
    page.locator("#edit-plan").click()
    for place in (form, page.locator("#venue-bar")):
        expect(place).to_be_hidden()
    page.evaluate("""() => { const dataTransfer = new DataTransfer();
        dataTransfer.items.add(new File(['{}'], 'other.json'));
        document.getElementById('plan-panel').dispatchEvent(new DragEvent('drop', { dataTransfer })); }""")
    expect(page.locator("#toast")).to_contain_text("Save or stop editing first, then add “other.json” again.")
    held[0].continue_()
    expect(page.locator("#toast")).to_contain_text("is stored: choose it under “Plans”")
    page.locator("#stop").click()
    expect(page.locator("#plan-name")).to_have_text(name)
    expect(form).to_be_empty()
    page.get_by_text("Plans", exact=True).click()
    expect(page.locator("#venue-list button")).to_have_count(2)


@pytest.mark.slow
def test_warnings_of_one_cause_are_one(desktop: Visit) -> None:
    plan_id = upload(desktop.client, FLAT | {"name": "Guessed"})
    plan = desktop.client.get(f"/floorplans/{plan_id}").json()
    gaps = [f"a gap of 0.8{index} m at ({index}.5, 2.25) is taken for a door" for index in range(3)]
    plan["import_report"] = {"is_draft": False, "unsure": [*gaps, "no door is drawn"], "no_room": []}
    desktop.page.route(f"**/floorplans/{plan_id}", lambda route: route.fulfill(json=plan))
    items = desktop.open(f"/#plan={plan_id}").locator("#plan-warnings > li")
    expect(items).to_have_text([f"{gaps[0]}2 more of this kind{gaps[1]}{gaps[2]}", "no door is drawn"])


@pytest.mark.slow
def test_deletion_of_a_plan_asks_first(desktop: Visit) -> None:
    for name in ("Attic of the mill", "Cellar of the mill"):
        upload(desktop.client, FLAT | {"name": name})
    page = desktop.open()
    page.get_by_text("Plans", exact=True).click()
    page.locator("#plan-search").fill("MILL")
    expect(page.locator("#plan-list .plan")).to_have_count(2)
    page.get_by_role("button", name="Delete Attic of the mill").click()
    page.get_by_role("button", name="Keep the plan").click()
    expect(page.locator("#plan-list .plan")).to_have_count(2)
    page.get_by_role("button", name="Delete Attic of the mill").click()
    page.get_by_role("button", name="Delete the plan").click()
    expect(page.locator("#plan-list .plan")).to_have_count(1)
    names = [plan["name"] for plan in desktop.client.get("/floorplans").json()["floorplans"]]
    assert "Attic of the mill" not in names


@pytest.mark.slow
def test_plans_of_one_name_show_date_and_revision(desktop: Visit) -> None:
    for _ in range(2):
        plan = {"floorplan_id": upload(desktop.client, FLAT | {"name": "Twin"}), "level": 0}
        desktop.client.post("/venues", json={"name": "Twins", "plans": [plan]}).raise_for_status()
    told = [re.compile(r"Twin.*stored \d+ \w+ \d{4}, [\d:]{8}(, revision 1)?$")] * 2
    lists = ("/", "#plan-list .plan"), ("/", "#venue-list .plan"), ("/pin", "[label=Plans] option")
    for path, entries in (*lists, ("/", "#venue-form-plan option")):
        expect(desktop.open(path).locator(entries, has_text="Twin")).to_have_text(told)


@pytest.mark.slow
def test_plan_becomes_ready_on_the_page(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, inline_grid_poses=0) as client:
        for visited in visit(browser, client):
            page = visited.open_example()
            page.get_by_text("Plans", exact=True).click()
            expect(page.locator("#plan-none")).to_have_text("No plan is stored yet.")
            page.locator("#plan-search").fill("castle")
            expect(page.locator("#plan-none")).to_have_text("No plan with this name.")
            page.keyboard.press("Escape")
            visited.find()
            expect(page.locator("#preparing")).to_be_hidden()
            expect(page.locator("#plan-name")).to_have_text("Example flat")


@pytest.mark.one_replica
@pytest.mark.slow
def test_page_asks_for_a_key(browser: Browser, start_app: StartApp, database_of: DatabaseOf, tmp_path: Path) -> None:
    with start_app(tmp_path, api_keys=True) as client:
        store = Store(database_of(tmp_path))
        secret, old = make_key(store), new_secret()
        expired = key_text(
            store.keys.create("ours", "old", hash_of(old), EVERYTHING, lifetime=timedelta(seconds=-60)).id, old
        )
        store.close()
        for visited in visit(browser, client):
            page = visited.open()
            dialog = page.locator("#key-dialog")
            expect(dialog).to_be_visible()
            _assert_accessible(page)
            page.locator("#key-field").fill("lalaloc_wrong")
            page.keyboard.press("Enter")
            expect(page.locator("#key-why")).to_contain_text("This key is not valid")
            page.locator("#key-field").fill(expired)
            page.keyboard.press("Enter")
            expect(page.locator("#key-why")).to_contain_text(re.compile(r"expired on \d+ \w+ \d{4}"))
            page.locator("#key-field").fill(secret)
            page.keyboard.press("Enter")
            expect(dialog).to_be_hidden()
            visited.choose_spheres()
            visited.find()
            page.reload()
            expect(page.locator("#photo-strip li")).to_have_count(4)
            expect(dialog).to_be_hidden()
            page.goto(f"{client.base_url}/docs")
            page.locator(".opblock-summary-control").first.wait_for()
            expect(page.locator(".auth-wrapper .authorize.locked")).to_be_visible()


@pytest.mark.slow
def test_docs_page_shows_and_sends_operations(desktop: Visit) -> None:
    plan_id = upload(desktop.client, FLAT | {"name": "Documented"})
    page = desktop.open("/docs")
    operation = page.locator("#operations-floor_plans-getFloorplan")
    operation.wait_for()
    found = Axe().run(page).response["violations"]
    # Swagger UI puts its padlock buttons into the rows that open, and gives its list of servers no label.
    faults = {fault["id"] for fault in found if fault["impact"] in ("serious", "critical")}
    assert faults <= {"nested-interactive", "select-name"}
    operation.locator(".opblock-summary-control").click()
    operation.get_by_role("button", name="Try it out").click()
    operation.get_by_placeholder("floorplan_id").fill(plan_id)
    operation.get_by_role("button", name="Execute").click()
    expect(operation.locator(".curl")).to_contain_text("curl")
    expect(operation.locator(".live-responses-table")).to_contain_text("Documented")


@pytest.mark.slow
def test_link_opens_an_answer_again(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as client:
        for visited in visit(browser, client):
            page = visited.open_example()
            visited.find()
            room = page.locator("#answer .room").inner_text()
            place = page.locator("#answer .where").inner_text()
            page.locator("#copy-link").click()
            link = page.locator("#copied").inner_text()
            page.goto("about:blank")
            page.goto(link)
            expect(page.locator("#answer .room")).to_have_text(room)
            expect(page.locator("#answer .where")).to_have_text(place)
            expect(page.locator("#fit-state")).to_contain_text("Add the photograph")
            # The page has the plan and the answer: nothing is asked again.
            page.route("**/localise*", lambda route: route.abort())
            with page.expect_download() as saving:
                page.get_by_role("button", name="Save picture").click()
            assert saving.value.suggested_filename == "lalaloc-answer.png"
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
            page.goto("about:blank")
            page.goto(f"{link[:-32]}{'0' * 32}")
            expect(page.locator("#plan-error")).to_contain_text("no answer is kept")


@pytest.mark.slow
def test_link_holds_an_answer_that_is_not_kept(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        for visited in visit(browser, client):
            page = visited.open_example()
            visited.find()
            where = page.locator("#answer .where").inner_text()
            page.locator("#copy-link").click()
            expect(page.locator("#copied")).to_contain_text("#answer-data=")
            link = page.locator("#copied").inner_text()
            assert len(link) < 8000
            page.goto("about:blank")
            asked: list[str] = []
            page.on("request", lambda request, asked=asked: asked.append(request.url))
            page.goto(link)
            expect(page.locator("#answer .where")).to_have_text(where)
            expect(page.locator("#answer-body")).to_contain_text("did not compute it again")
            assert not [url for url in asked if "/localise" in url]
            page.goto("about:blank")
            page.goto(link[:-40])
            expect(page.locator("#plan-error")).to_contain_text("damaged or incomplete")


@pytest.mark.slow
def test_photographed_rooms_are_an_example(desktop: Visit) -> None:
    page = desktop.open()
    for _ in range(2):
        page.get_by_text("Plans", exact=True).click()
        page.get_by_role("button", name="Photographed rooms", exact=True).click()
        expect(page.locator("#plan-name")).to_have_text("Six photographed rooms")
    # Its photograph is added once, and its plan is stored once.
    expect(page.locator("#photo-strip button.thumb", has_text="lythwood_room")).to_have_count(1)
    page.locator("#find").click()
    expect(page.locator("#answer-body")).to_contain_text("Possible places", timeout=60_000)
    page.get_by_text("Plans", exact=True).click()
    expect(page.locator("#plan-list button.plan", has_text="Six photographed rooms")).to_have_count(1)


@pytest.mark.slow
def test_search_waits_for_the_plan_that_is_loading(desktop: Visit) -> None:
    page, held = desktop.open(), list[Route]()
    rooms = page.get_by_role("button", name="Photographed rooms", exact=True)
    page.get_by_text("Plans", exact=True).click()
    rooms.click()
    expect(page.locator("#plan-name")).to_have_text("Six photographed rooms")
    expect(page.locator("#photo-strip button.thumb", has_text="lythwood_room")).to_have_count(1)
    page.route("**/web/example-rooms.json", lambda route: held.append(route))
    page.get_by_text("Plans", exact=True).click()
    rooms.click()
    page.locator("#find").click()
    expect(page.locator("#find")).to_have_attribute("aria-busy", "true")
    held[0].continue_()
    expect(page.locator("#answer-body")).to_contain_text("Possible places", timeout=60_000)


@pytest.mark.slow
def test_false_scale_of_a_picture_is_corrected_with_one_click(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    (tmp_path / "printed.png").write_bytes(PrintedPlan().file())
    page.locator("#plan-file").set_input_files(tmp_path / "printed.png")
    page.get_by_text("Other ways to state the scale").click()
    page.get_by_label("Metres per pixel").fill("0.02")
    page.get_by_role("button", name="Read the picture").click()
    apply = page.get_by_role("button", name=re.compile(r"Apply × 0\.7\d\d to all lengths"))
    expect(apply).to_be_visible(timeout=120_000)
    expect(page.locator("#plan-warnings")).to_contain_text("check both")
    apply.click()
    expect(page.locator("#plan-facts")).to_contain_text(re.compile(r"3 rooms, 5[012]\."), timeout=120_000)


@pytest.mark.slow
def test_part_of_a_picture_is_read_in_a_frame(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open()
    _scan().save(tmp_path / "scan.png")
    page.locator("#plan-file").set_input_files(tmp_path / "scan.png")
    page.get_by_text("Other ways to state the scale").click()
    page.get_by_label("Metres per pixel").fill("0.01")
    page.get_by_label("Drag a frame around the part to read").check()
    drag(page, _on_screen(page, 60, 60), _on_screen(page, 840, 640))
    expect(page.locator(".measured .frame")).to_have_count(1)
    page.get_by_role("button", name="Read the picture").click()
    expect(page.locator("#plan-facts")).to_contain_text("2 rooms")
