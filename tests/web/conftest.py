"""Fixtures of the pages' tests: headless Chromium on the production app."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, expect, sync_playwright

from tests.service.conftest import (  # noqa: F401, fixtures
    _clean_environment,
    _forked_workers,
    app_settings,
    database_of,
    empty_database,
    start_app,
)
from tests.service.conftest import client as service

__all__ = ["service"]

EXAMPLES = Path(__file__).parents[2] / "examples"
DESKTOP = {"width": 1280, "height": 900}
PHONE = {"width": 390, "height": 844}

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# WebGL in software, as there is no graphics card.
_ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_TIMEOUT_MS = 30_000.0


@dataclass
class Visit:
    """A page in the browser, and its errors."""

    page: Page
    client: httpx.Client
    errors: list[str] = field(default_factory=list)

    def open(self, path: str = "/") -> Page:
        self.page.goto(str(self.client.base_url).rstrip("/") + path)
        return self.page

    def open_example(self) -> Page:
        """Load the start page and choose the example's spheres."""
        self.open()
        return self.choose_spheres()

    def choose_spheres(self) -> Page:
        """Choose the example's spheres instead of the turn with which the page begins."""
        page = self.page
        expect(page.locator("#photo-strip li")).to_have_count(4)
        page.get_by_text("Plans", exact=True).click()
        page.locator("#example-spheres").click()
        expect(page.locator("#photo-strip")).to_contain_text("kitchen.jpg")
        # The viewer sets its shape after loading the photograph.
        expect(page.locator(".stage")).to_have_attribute("data-shape", re.compile("around|whole"))
        return page

    def find(self) -> Page:
        """Localise the chosen photograph and wait for the answer."""
        self.page.get_by_role("button", name="Find the place").click()
        expect(self.page.locator("#answer")).to_be_visible()
        return self.page

    def stored(self, name: str) -> dict[str, Any]:
        """Return the only stored plan of a name."""
        (listed,) = self.client.get("/floorplans", params={"name": name}).json()["floorplans"]
        return self.client.get(f"/floorplans/{listed['id']}").json()


def wait_until(page: Page, condition: str, argument: object = None) -> None:
    """Wait until a function of the page returns true.

    Playwright's own wait evaluates text in the page, which its content security policy forbids after the first try.
    """
    deadline = time.monotonic() + _TIMEOUT_MS / 1000.0
    while not page.evaluate(condition, argument):
        assert time.monotonic() < deadline, f"never true: {condition}"
        page.wait_for_timeout(50.0)


def choose_plan(page: Page, name: str) -> None:
    """Choose a stored plan from the menu, which closes."""
    page.get_by_text("Plans", exact=True).click()
    page.locator("#plan-list").get_by_role("button", name=name, exact=False).first.click()
    expect(page.locator("#plan-name")).to_have_text(name)
    expect(page.locator("#plan-list")).to_be_hidden()


def drag(page: Page, begin: tuple[float, float], end: tuple[float, float]) -> None:
    """Press the mouse at a place of the screen, and release it at another."""
    page.mouse.move(*begin)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    page.mouse.up()


# Not for the session: Playwright's event loop prevents other tests from running one.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if path is None:
        pytest.skip("Chromium is not installed; on Debian and Ubuntu: apt-get install chromium")
    expect.set_options(timeout=_TIMEOUT_MS)
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS)
        yield launched
        launched.close()


def _context(browser: Browser, **options: Any) -> BrowserContext:
    values: dict[str, Any] = {"viewport": DESKTOP} | options
    context = browser.new_context(**values)
    context.set_default_timeout(_TIMEOUT_MS)
    return context


def visit(browser: Browser, client: httpx.Client, **options: Any) -> Iterator[Visit]:
    """Yield a visit; errors and warnings in the console fail the test.

    Args:
        browser: running browser.
        client: service to visit.
        options: options of the browser context, such as `viewport` or `color_scheme`.
    """
    with _context(browser, **options) as context:
        visited = Visit(context.new_page(), client)

        def record(message: ConsoleMessage) -> None:
            # The browser also reports rejected requests, which the page handles.
            if message.type in ("error", "warning") and "Failed to load resource" not in message.text:
                visited.errors.append(message.text)

        visited.page.on("console", record)
        visited.page.on("pageerror", lambda error: visited.errors.append(str(error)))
        yield visited
    assert [error for error in visited.errors if "GPU stall" not in error and "swiftshader" not in error.lower()] == []


@pytest.fixture
def desktop(browser: Browser, service: httpx.Client) -> Iterator[Visit]:
    yield from visit(browser, service)


@pytest.fixture
def phone(browser: Browser, service: httpx.Client) -> Iterator[Visit]:
    yield from visit(browser, service, viewport=PHONE, has_touch=True, is_mobile=True, device_scale_factor=2)
