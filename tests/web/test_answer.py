"""The start page from the first visit to an answer."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, Route, expect

from tests.service.conftest import FLAT, upload
from tests.strategies import present
from tests.web.conftest import EXAMPLES, PHONE, Visit, choose_plan, drag, visit, wait_until


def _marker(page: Page) -> tuple[float, float]:
    x, y = re.findall(r"-?[\d.]+", page.locator("#marker").get_attribute("transform") or "")
    return float(x), -float(y)


def _assert_hottest_at(page: Page, x_m: float, y_m: float) -> None:
    """Check that the strongest colour of the heat map lies at a place."""
    places = page.evaluate(
        """async () => { const strongest = [];
        const ramp = getComputedStyle(document.documentElement).getPropertyValue('--heat-ramp');
        const last = ramp.split(',').at(-1).trim();
        const colour = [1, 3, 5].map((start) => parseInt(last.slice(start, start + 2), 16));
        for (const image of document.querySelectorAll('#plan .heat image')) {
            const shown = new Image(); shown.src = image.getAttribute('href'); await shown.decode();
            const canvas = document.createElement('canvas');
            const [width, height] = [canvas.width, canvas.height] = [shown.width, shown.height];
            const context = canvas.getContext('2d'); context.drawImage(shown, 0, 0);
            const pixels = context.getImageData(0, 0, width, height).data;
            const box = ['x', 'y', 'width', 'height'].map((name) => Number(image.getAttribute(name)));
            for (let i = 0; i < width * height; i++) {
                const off = Math.max(...colour.map((value, k) => Math.abs(value - pixels[4 * i + k])));
                const [column, row] = [i % width, Math.floor(i / width)];
                if (off <= 3 && pixels[4 * i + 3] > 200)
                    strongest.push([box[0] + (column + 0.5) / width * box[2], -box[1] - (row + 0.5) / height * box[3]]);
            } }
        return strongest; }"""
    )
    assert places != []
    middle = [sum(axis) / len(places) for axis in zip(*places, strict=True)]
    assert middle == pytest.approx([x_m, y_m], abs=0.15)


def _assert_accessible(page: Page) -> None:
    violations = Axe().run(page).response["violations"]
    serious = [violation for violation in violations if violation["impact"] in ("serious", "critical")]
    messages = [f"{violation['id']}: {node['html']}" for violation in serious for node in violation["nodes"]]
    assert messages == [], "\n".join(messages)


@pytest.mark.slow
def test_heat_map_is_as_wide_as_the_answer(desktop: Visit) -> None:
    """The pose grid of 0.5 m blurs the map by 0.2 m; an answer is more accurate."""
    reaches = desktop.open().evaluate(
        """async () => { const { heatMap } = await import('/web/app.js');
        const plan = { rooms: [{ polygon: [[0, 0], [5, 0], [5, 5], [0, 5]] }] }, position = { x_m: 2.6, y_m: 2.4 };
        const posterior = { x_m: [2.5, 3, 2.5], y_m: [2.5, 2.5, 3], probability: [0.9, 0.08, 0.02], step_m: 0.5 };
        const reach = async (covariance_m2) => { let farthest = 0;
            const image = heatMap(posterior, plan, { position, covariance_m2 }).querySelector('image');
            const shown = new Image(); shown.src = image.getAttribute('href'); await shown.decode();
            const canvas = document.createElement('canvas');
            const [width, height] = [canvas.width, canvas.height] = [shown.width, shown.height];
            const context = canvas.getContext('2d'); context.drawImage(shown, 0, 0);
            const pixels = context.getImageData(0, 0, width, height).data;
            for (let i = 0; i < width * height; i++)
                if (pixels[4 * i + 3] > 20) {
                    const x = (i % width + 0.5) / width * 5, y = 5 - (Math.floor(i / width) + 0.5) / height * 5;
                    farthest = Math.max(farthest, Math.hypot(x - position.x_m, y - position.y_m));
                }
            return farthest; };
        return [await reach(null), await reach([[0.0016, 0], [0, 0.0016]]), await reach([[0.16, 0], [0, 0.0016]])]; }"""
    )
    grid, round_, long = reaches
    assert grid > 0.9
    assert round_ < 0.25
    assert 1.4 < long < 2.2


def test_first_visit_leads_to_an_answer_with_one_click(desktop: Visit) -> None:
    page = desktop.open_example()
    expect(page.locator("#plan .room")).to_have_count(7)
    _assert_accessible(page)
    desktop.find()
    expect(page.locator("#answer .room")).not_to_be_empty()
    _assert_hottest_at(page, *_marker(page))
    expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
    # The canvas over the photograph has yellow lines.
    yellow = page.evaluate(
        """() => { const canvas = document.querySelector('canvas.overlay');
        const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
        let count = 0;
        for (let i = 0; i < pixels.length; i += 4)
            if (pixels[i] > 240 && pixels[i + 1] > 210 && pixels[i + 2] < 110) count++;
        return count; }"""
    )
    assert yellow > 200
    _assert_accessible(page)
    page.get_by_role("button", name="Whole picture").click()
    expect(page.locator(".stage")).to_have_attribute("data-shape", "whole")


def test_dragged_marker_moves_the_layout(desktop: Visit) -> None:
    page = desktop.open_example()
    desktop.find()
    expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
    begin, state = _marker(page), page.locator("#fit-state").inner_text()
    grip = present(page.locator("#marker .dot").bounding_box())
    drag(page, (grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2), (grip["x"] + 25, grip["y"] + 18))
    assert _marker(page) != begin
    expect(page.locator("#fit-state")).not_to_have_text(state)
    page.locator("[data-rank='0']").click()
    assert _marker(page) == pytest.approx(begin)
    expect(page.locator("#fit-state")).to_have_text(state)
    second = page.locator("[data-rank]").nth(1)
    second.click()
    expect(second).to_have_attribute("aria-pressed", "true")
    assert _marker(page) != pytest.approx(begin)


def _expect_marker(page: Page, x_m: float, y_m: float) -> None:
    """Wait until the marker is at a place."""
    wait_until(
        page,
        """([x, y]) => { const found = document.querySelector('#marker').getAttribute('transform').match(/-?[\\d.]+/g);
        return Math.hypot(found[0] - x, -found[1] - y) < 1e-3; }""",
        [x_m, y_m],
    )


def test_keyboard_alone_leads_to_an_answer(desktop: Visit) -> None:
    page = desktop.open_example()
    page.locator("#heading").focus()
    # Past the forms that begin in between.
    for _ in range(8):
        if page.evaluate("document.activeElement.id") != "find":
            page.keyboard.press("Shift+Tab")
    expect(page.locator("#find")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#answer")).to_be_visible()
    expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
    page.locator("#marker").focus()
    x, y = _marker(page)
    page.keyboard.press("ArrowRight")
    _expect_marker(page, x + 0.05, y)
    page.keyboard.press("Shift+ArrowUp")
    _expect_marker(page, x + 0.05, y + 0.5)
    page.locator("#stage").focus()
    before = page.locator("#marker .cone").get_attribute("d")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#marker .cone")).not_to_have_attribute("d", before or "")
    page.locator("#compass").focus()
    for key, heading in (("Home", "0"), ("PageUp", "10"), ("ArrowRight", "11"), ("Delete", "")):
        page.keyboard.press(key)
        expect(page.locator("#heading")).to_have_value(heading)


@pytest.mark.slow
def test_late_layout_keeps_the_moved_marker(desktop: Visit) -> None:
    page, held = desktop.page, list[Route]()
    page.route("**/layout*", lambda route: held.append(route))
    desktop.open_example()
    desktop.find()
    page.locator("#marker").focus()
    x, y = _marker(page)
    page.keyboard.press("ArrowRight")
    _expect_marker(page, x + 0.05, y)
    for route in held:
        route.continue_()
    expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
    expect(page.locator("#marker")).to_be_focused()
    _expect_marker(page, x + 0.05, y)


@pytest.mark.slow
def test_choosing_another_plan_aborts_the_query(desktop: Visit) -> None:
    for name in ("Chosen first", "Chosen second"):
        upload(desktop.client, FLAT | {"name": name})
    page = desktop.open()
    page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
    choose_plan(page, "Chosen first")
    held = list[Route]()
    page.route("**/localise", lambda route: held.append(route))
    with page.expect_request("**/localise"):
        page.locator("#find").click()
    choose_plan(page, "Chosen second")
    expect(page.locator("#find")).not_to_have_attribute("aria-busy", "true")
    (route,) = held
    # Without an abort this answer would switch the page back to the first plan.
    route.continue_()
    page.wait_for_load_state("networkidle")
    expect(page.locator("#plan-name")).to_have_text("Chosen second")
    expect(page.locator("#answer")).to_be_hidden()
    page.unroute("**/localise")
    desktop.find()
    expect(page.locator("#plan-name")).to_have_text("Chosen second")


@pytest.mark.slow
def test_error_marks_its_field_and_hides_the_answer(desktop: Visit) -> None:
    page = desktop.open_example()
    desktop.find()
    page.get_by_text("Heading and hints").click()
    page.locator("#heading").fill("400")
    page.get_by_text("Heading and hints").click()
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#photo-error")).to_contain_text("Heading")
    expect(page.locator("#photo-error")).not_to_contain_text("heading_deg")
    # The form unfolds, so that its faulty field is in sight.
    expect(page.locator("#heading")).to_be_visible()
    expect(page.locator("#heading")).to_have_attribute("aria-invalid", "true")
    expect(page.locator("#answer")).to_be_hidden()
    page.locator("#heading").fill("40")
    expect(page.locator("#photo-error")).to_be_hidden()
    desktop.find()
    assert "heading_deg=40" in _copied(page, "#copy-curl")
    assert "heading_deg=40" in _copied(page, "#copy-python")


def _copied(page: Page, button: str) -> str:
    page.locator(button).click()
    return page.locator("#copied").inner_text()


@pytest.mark.slow
def test_other_files_than_photographs_are_rejected(desktop: Visit, tmp_path: Path) -> None:
    page = desktop.open_example()
    (tmp_path / "notes.txt").write_text("no picture")
    page.locator("#photo-file").set_input_files(tmp_path / "notes.txt")
    expect(page.locator("#photo-error")).to_contain_text("must be JPEG, PNG, WebP or HEIC files")
    expect(page.locator("#photo-strip li")).to_have_count(4)
    paths = [tmp_path / name for name in ("10.jpg", "2.jpg", "._2.jpg", "empty.jpg")]
    for path in paths:
        path.write_bytes((EXAMPLES / "turn_1.jpg").read_bytes() if path.stem.isdecimal() else b"")
    page.locator("#photo-file").set_input_files(paths)
    expect(page.locator("#photo-error")).to_contain_text("“._2.jpg”, “empty.jpg”: ")
    expect(page.locator("#photo-strip .thumb")).to_have_text(["2.jpg", "10.jpg"])
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff no picture")
    page.locator("#photo-file").set_input_files(tmp_path / "broken.jpg")
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#photo-error")).to_be_visible()
    expect(page.locator("#answer")).to_be_hidden()


def test_phone_needs_no_horizontal_scrolling(phone: Visit) -> None:
    page = phone.open()
    expect(page.locator("#find")).to_be_in_viewport(ratio=1.0)
    phone.choose_spheres()
    phone.find()
    assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    for selector in ("#plan", "#stage", "#find", "#answer", "#edit-plan", "#draw-plan"):
        box = present(page.locator(selector).bounding_box())
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
    _assert_accessible(page)


def test_dark_mode_has_enough_contrast(browser: Browser, service: httpx.Client) -> None:
    for visited in visit(browser, service, color_scheme="dark"):
        page = visited.open_example()
        visited.find()
        _assert_accessible(page)


@pytest.mark.slow
@pytest.mark.parametrize("size", [{"width": 1440, "height": 900}, PHONE])
def test_answer_is_visible_without_scrolling(browser: Browser, service: httpx.Client, size: dict[str, int]) -> None:
    for visited in visit(browser, service, viewport=size):
        page = visited.open_example()
        visited.find()
        for part in (".verdict", ".places", "#plan"):
            expect(page.locator(part)).to_be_in_viewport(ratio=0.3)
        expect(page.locator(".verdict")).to_be_in_viewport(ratio=1.0)
        expect(page.locator("#heading")).to_be_hidden()
        # The heading that was found is on the compass.
        expect(page.locator("#compass-place")).to_contain_text(re.compile(r"found \d+°"))


@pytest.mark.slow
def test_near_candidates_are_one_place_and_all_places_add_up(desktop: Visit) -> None:
    poses = [(1.0, 1.0, 0.31), (1.4, 1.0, 0.37), (5.0, 5.0, 0.2), (5.0, 5.9, 0.003), (8.0, 8.0, 0.004)]
    candidates = [
        {"floorplan_id": "flat", "position": {"x_m": x_m, "y_m": y_m}, "probability": probability}
        for x_m, y_m, probability in poses
    ]
    answer = {"candidates": candidates, "confidence": 0.7, "probability_elsewhere": 0.05}
    places, rest = desktop.open().evaluate(
        """async (answer) => { const { placesOf, remainder } = await import('/web/app.js');
        const places = placesOf(answer); return [places, remainder(answer, places)]; }""",
        answer,
    )
    assert [(place["index"], place["others"]) for place in places] == [(0, [1]), (2, [])]
    # The first place has the confidence, which counts every heading.
    assert [place["probability"] for place in places] == pytest.approx([0.7, 0.203])
    assert rest == pytest.approx(1.0 - 0.05 - 0.7 - 0.203)


@pytest.mark.slow
def test_answers_to_all_photographs_are_a_table(desktop: Visit) -> None:
    page = desktop.open_example()
    page.get_by_role("button", name="Find all").click()
    table = page.locator("#all-answers table")
    expect(table.locator("tbody tr")).to_have_count(4)
    expect(page.locator("#plan .companion")).to_have_count(3)
    _assert_accessible(page)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save CSV").click()
    with download.value.path().open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["photograph"] for row in rows] == ["kitchen.jpg", "living_room.jpg", "bedroom.jpg", "study.jpg"]
    texts = page.evaluate("async () => ['-1', ' ＝1', 'a;=1', 'a'].map((await import('/web/app.js')).quoted)")
    assert texts == ["'-1", "' ＝1", "a;'=1", "a"]
    table.get_by_role("button", name="bedroom.jpg").click()
    expect(page.locator(".thumb[aria-pressed='true']")).to_contain_text("✓")
    expect(page.locator("#answer .room")).to_have_text(rows[2]["room"])
    expect(page.locator("#answer .where")).to_contain_text(f"x {float(rows[2]['x_m']):.2f} m")


@pytest.mark.slow
def test_flat_picture_without_webgl(desktop: Visit) -> None:
    desktop.page.add_init_script(
        "HTMLCanvasElement.prototype.getContext = ((original) => function (kind, ...rest) {"
        "return kind.startsWith('webgl') ? null : original.call(this, kind, ...rest); })"
        "(HTMLCanvasElement.prototype.getContext)"
    )
    page = desktop.open_example()
    expect(page.locator(".stage")).to_have_attribute("data-shape", "whole")
    expect(page.get_by_role("button", name="From inside")).to_be_disabled()
    desktop.find()
    # The viewer reports the missing WebGL.
    desktop.errors.clear()


@pytest.mark.slow
def test_stored_plan_is_shown_instead_of_the_example(desktop: Visit) -> None:
    desktop.client.post("/floorplans", json=FLAT)
    for plan in desktop.client.get("/floorplans", params={"name": "Example"}).json()["floorplans"]:
        desktop.client.delete(f"/floorplans/{plan['id']}")
    page = desktop.open()
    expect(page.locator("#plan-name")).to_have_text("Flat 3")
    expect(page.locator("#find")).to_be_disabled()
    page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
    desktop.find()


def test_find_all_localises_every_photograph(desktop: Visit) -> None:
    page = desktop.open()
    # A plan that is shown later ends the search.
    expect(page.locator("#plan-name")).not_to_be_empty()
    page.locator("#photo-file").set_input_files([EXAMPLES / "kitchen.jpg", EXAMPLES / "study.jpg"])
    page.get_by_role("button", name="Find all").click()
    expect(page.locator(".thumb span", has_text="✓")).to_have_count(page.locator(".thumb").count())
    expect(page.locator("#answer")).to_be_visible()
