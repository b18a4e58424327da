"""Venues on the start page: groups of plans that are searched together."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.importers.test_pictures import vector_pdf
from tests.service.conftest import FLAT, StartApp, upload
from tests.service.test_venue_levels import geojson
from tests.web.conftest import EXAMPLES, PHONE, visit
from tests.web.test_answer import _assert_accessible


@pytest.mark.slow
def test_answer_of_a_venue_names_the_plan(browser: Browser, start_app: StartApp, tmp_path) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as client:
        ids = [upload(client, FLAT | {"name": name}) for name in ("Flat below", "Flat above")]
        plans = [{"floorplan_id": plan_id, "level": level} for level, plan_id in enumerate(ids)]
        client.post("/venues", json={"name": "Mill", "plans": plans}).raise_for_status()
        for visited in visit(browser, client):
            page = visited.open()
            page.get_by_text("Plans", exact=True).click()
            page.get_by_role("button", name="Mill").click()
            expect(page.locator("#venue-bar")).to_contain_text("Mill 2 plans")
            expect(page.locator("#plan-name")).to_have_text("Flat below")
            expect(page.locator("#hints")).to_be_hidden()
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            visited.find()
            _assert_accessible(page)
            plan_of = page.locator("#answer .plan-of")
            expect(plan_of).to_have_text(
                "Flat below, level 0" if "below" in plan_of.inner_text() else "Flat above, level 1"
            )
            found = plan_of.inner_text().split(",")[0]
            # Selecting the candidate returns to the plan of the answer.
            expect(page.locator("#plan-name")).to_have_text(found)
            expect(page.locator("#plan #marker")).to_have_count(1)
            other = next(name for name in ("Flat below", "Flat above") if name != found)
            page.get_by_label("Plan shown").select_option(label=f"{other}, level {int(other == 'Flat above')}")
            expect(page.locator("#plan-name")).to_have_text(other)
            expect(page.locator("#fit-state")).to_contain_text("another plan of the venue")
            page.locator("[data-rank='0']").click()
            expect(page.locator("#plan-name")).to_have_text(found)
            expect(page.locator("#fit-state")).to_contain_text("Layout as seen from")
            page.locator("#copy-python").click()
            expect(page.locator("#copied")).to_contain_text("service.localise_in_venue(")
            page.locator("#copy-link").click()
            link = page.locator("#copied").inner_text()
            page.get_by_role("button", name="Search only this plan").click()
            expect(page.locator("#venue-bar")).to_be_hidden()
            expect(page.locator("#answer")).to_be_hidden()
            page.goto("about:blank")
            page.goto(link)
            expect(plan_of).to_contain_text(found)
            expect(page.locator("#venue-bar")).to_contain_text("Mill")


def test_venue_is_created_and_searched(browser: Browser, start_app: StartApp, tmp_path) -> None:
    with start_app(tmp_path) as client:
        for name in ("Cellar", "Shop"):
            upload(client, FLAT | {"name": name})
        for visited in visit(browser, client, viewport=PHONE):
            page = visited.open()
            page.get_by_text("Plans", exact=True).click()
            page.get_by_text("Create a venue").click()
            make = page.get_by_role("button", name="Create the venue")
            make.click()
            expect(page.locator("#venue-error")).to_contain_text("Enter a name for the venue")
            page.get_by_label("Name of the venue").fill("Mill Lane 12")
            add = page.get_by_role("button", name="Add", exact=True)
            for name in ("Cellar", "Shop"):
                page.get_by_label("Plan to add").select_option(label=name)
                add.click()
            expect(add).to_be_disabled()
            page.get_by_label("Level of Cellar").fill("")
            make.click()
            expect(page.locator("#venue-error")).to_contain_text("Enter the level of Cellar")
            page.get_by_label("Level of Cellar").fill("-1")
            page.get_by_label("Level of Shop").fill("2000000")
            make.click()
            expect(page.get_by_label("Level of Shop")).to_have_attribute("aria-invalid", "true")
            page.get_by_label("Level of Shop").fill("0")
            _assert_accessible(page)
            make.click()
            expect(page.locator("#venue-bar")).to_contain_text("Mill Lane 12 2 plans")
            expect(page.locator("#plan-name")).to_have_text("Cellar")
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            visited.find()
            expect(page.locator("#answer .plan-of")).to_contain_text("level")


@pytest.mark.slow
def test_pdf_levels_of_a_file_and_a_photograph_lead_to_an_answer(
    browser: Browser, start_app: StartApp, tmp_path: Path
) -> None:
    (tmp_path / "ground floor.pdf").write_bytes(vector_pdf())
    (tmp_path / "house.geojson").write_bytes(geojson())
    with start_app(tmp_path / "service") as client:
        for visited in visit(browser, client, viewport=PHONE):
            page = visited.open()
            page.locator("#plan-file").set_input_files(tmp_path / "ground floor.pdf")
            expect(page.locator("#plan-name")).to_have_text("ground floor")
            page.locator("#plan-file").set_input_files(tmp_path / "house.geojson")
            page.get_by_role("button", name="Import all levels as a venue").click()
            expect(page.locator("#venue-bar")).to_be_visible()
            expect(page.locator("#venue-plan option")).to_have_text(["Level 0", "Level 1"])
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            visited.find()
            # An answer that is higher than the window begins at its top.
            expect(page.locator("#answer .verdict")).to_be_in_viewport()
