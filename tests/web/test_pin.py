"""The page that pins a folder of photographs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from lalaloc_core.bundle import default_bundle
from tests.service.conftest import StartApp, upload
from tests.web.conftest import EXAMPLES, Visit

FLAT = json.loads((EXAMPLES / "flat.json").read_text())
FILES = [EXAMPLES / name for name in ("living_room.jpg", "kitchen.jpg", "bedroom.jpg")]


@pytest.fixture(scope="module")
def service(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Return an app with the shipped model and a plan, as the tiny model gives no features."""
    folder = tmp_path_factory.mktemp("data")
    with start_app(folder, bundle=default_bundle(), request_deadline_s=90.0, sweep_s=0.2) as client:
        upload(client, FLAT | {"name": "Pinned flat"})
        yield client


def test_folder_is_pinned_corrected_and_undone(phone: Visit, tmp_path: Path) -> None:
    page = phone.open("/pin")
    expect(page.locator("#plan .room")).to_have_count(len(FLAT["rooms"]))
    damaged = tmp_path / "damaged.jpg"
    damaged.write_bytes(b"no picture")
    page.locator("#photo-files").set_input_files([*FILES, damaged])
    expect(page.locator(".card")).to_have_count(3)
    expect(page.locator("#problems li")).to_contain_text("damaged.jpg")
    expect(page.locator("#pin-state")).to_contain_text("(solved)")
    expect(page.locator("#plan .pin")).to_have_count(3)
    expect(page.locator(".card img")).to_have_count(3)
    pin = page.locator("#pin-1")
    before = pin.get_attribute("transform")
    # By keyboard alone: the pin moves, its arrow turns, and both are undone.
    pin.focus()
    page.keyboard.press("ArrowUp")
    expect(pin).to_have_class("pin corrected")
    expect(pin).not_to_have_attribute("transform", before or "")
    page.get_by_role("button", name="Undo").click()
    expect(pin).not_to_have_class("pin corrected")
    expect(pin).to_have_attribute("transform", before or "")
    page.get_by_role("button", name="Elsewhere").last.click()
    expect(page.locator("#plan .pin")).to_have_count(2)
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#plan .pin")).to_have_count(3)
    with page.expect_download() as table:
        page.get_by_role("button", name="CSV").click()
    assert "kitchen.jpg" in Path(table.value.path()).read_text()
    page.locator("#room-filter").select_option(label="kitchen")
    kitchen = page.locator("#plan .pin").count()
    assert kitchen < 3
    assert page.locator(".card").count() == kitchen
    page.locator("#room-filter").select_option("")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
