"""Venues on the start page: groups of plans that are searched together."""

from __future__ import annotations

import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from lalaloc_core.floorplan.earth import Anchor
from tests.importers.test_pictures import vector_pdf
from tests.service.conftest import FLAT, StartApp, upload
from tests.service.test_venue_levels import geojson
from tests.web.conftest import EXAMPLES, PHONE, visit
from tests.web.test_answer import _assert_accessible, _copied


def _make_mill(client: httpx.Client, **venue: Any) -> list[str]:
    """Store a venue of two plans on levels 0 and 1; return their ids."""
    ids = [upload(client, FLAT | {"name": name}) for name in ("Flat below", "Flat above")]
    plans = [{"floorplan_id": plan_id, "level": level} for level, plan_id in enumerate(ids)]
    client.post("/venues", json={"name": "Mill", "plans": plans} | venue).raise_for_status()
    return ids


def _choose_mill(page: Page) -> None:
    page.get_by_text("Plans", exact=True).click()
    page.get_by_role("button", name="Mill").click()
    expect(page.locator("#venue-bar")).to_contain_text("Mill 2 plans")
    expect(page.locator("#plan-name")).to_have_text("Flat below")


def _asked(page: Page) -> dict[str, str]:
    """Return the fields of the query of the answer, from its curl command."""
    words = shlex.split(_copied(page, "#copy-curl"))
    return dict(value.split("=", 1) for option, value in itertools.pairwise(words) if option == "-F")


@pytest.mark.slow
def test_answer_of_a_venue_names_the_plan(browser: Browser, start_app: StartApp, tmp_path) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as client:
        _make_mill(client)
        for visited in visit(browser, client):
            page = visited.open()
            _choose_mill(page)
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            page.locator("#hints summary").click()
            # A mark needs the plan's place on Earth.
            mark = page.locator("#hint-mark")
            expect(mark).to_be_disabled()
            expect(page.locator("#hint-unplaced")).to_be_visible()
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
            expect(mark).to_be_enabled()
            page.goto("about:blank")
            page.goto(link)
            expect(plan_of).to_contain_text(found)
            expect(page.locator("#venue-bar")).to_contain_text("Mill")


@pytest.mark.slow
def test_hints_about_a_venue_are_set_and_sent(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        _make_mill(client, anchor={"latitude": 51.75, "longitude": -1.25, "north_deg": 30.0})
        for visited in visit(browser, client):
            page = visited.open()
            _choose_mill(page)
            page.locator("#photo-file").set_input_files(EXAMPLES / "kitchen.jpg")
            page.locator("#hints summary").click()
            page.get_by_role("button", name="Mark the place on the plan").click()
            mark = page.locator(".hint-circle .grip")
            expect(mark).to_be_focused()
            page.keyboard.press("Shift+ArrowRight")
            x_m, y_m = (float(mark.get_attribute(name) or "nan") for name in ("cx", "cy"))
            # All plans of the venue share the mark.
            page.get_by_label("Plan shown").select_option(label="Flat above, level 1")
            expect(page.locator("#plan-name")).to_have_text("Flat above")
            assert float(mark.get_attribute("cx") or "nan") == pytest.approx(x_m, abs=0.001)
            page.get_by_role("checkbox", name="kitchen").check()
            page.get_by_label("Level", exact=True).fill("1")
            expect(page.locator("#hints-summary")).to_have_text("within 3 m of the mark, in one room, on level 1")
            _assert_accessible(page)
            visited.find()
            fields = _asked(page)
            near = json.loads(fields["near"])
            place = Anchor(51.75, -1.25, north_deg=30.0).to_plan(np.array([[near["longitude"], near["latitude"]]]))
            assert place[0] == pytest.approx([x_m, -y_m], abs=0.001)
            assert fields.items() >= {"radius_m": "3", "rooms": '["kitchen"]', "level": "1"}.items()
            assert "floorplan_id" not in fields
            assert 'rooms=["kitchen"], level=1' in _copied(page, "#copy-python")
            # An error names the field.
            page.get_by_text("Heading and hints").click()
            page.get_by_label("Level", exact=True).fill("7")
            page.get_by_role("button", name="Find the place").click()
            expect(page.locator("#photo-error")).to_contain_text("no floor plan of the venue is on level 7")
            # The hints end with the venue.
            page.get_by_role("button", name="Search only this plan").click()
            expect(page.locator("#hints-summary")).to_be_empty()
            expect(page.get_by_label("Level", exact=True)).to_be_hidden()


@pytest.mark.slow
def test_photographs_of_a_visit_are_one_query_in_a_venue(browser: Browser, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        _make_mill(client)
        for visited in visit(browser, client, viewport=PHONE):
            page = visited.open()
            _choose_mill(page)
            page.locator("#photo-file").set_input_files([EXAMPLES / "kitchen.jpg", EXAMPLES / "study.jpg"])
            page.get_by_label("Taken from one spot, turning").check()
            expect(page.locator("#hints")).to_be_hidden()
            with page.expect_response("**/localise/sequence") as received:
                visited.find()
            expect(page.locator("#answer-body")).to_contain_text("From 2 photographs together")
            poses = received.value.json()["poses"]
            # Each photograph shows the plan of its pose.
            for thumb, pose in zip(page.locator(".thumb").all(), poses, strict=True):
                thumb.click()
                name = ("Flat below", "Flat above")[int(pose["level"])]
                expect(page.locator("#answer .plan-of")).to_have_text(f"{name}, level {pose['level']:g}")
                expect(page.locator("#plan-name")).to_have_text(name)
                expect(page.locator("#plan #marker")).to_have_count(1)
            _assert_accessible(page)
            assert {"venue_id", "motion"} <= _asked(page).keys()
            assert re.search(
                r'localise_sequence\(None, \["kitchen.jpg", .*venue_id=".*motion="turn"', _copied(page, "#copy-python")
            )


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
