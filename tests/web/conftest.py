"""Fixtures of the pages' tests: Chromium without a screen, on the production app."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, expect, sync_playwright

from tests.service.conftest import (
    StartApp,
    _no_settings_from_outside,  # noqa: F401
    database_of,  # noqa: F401
    start_app,  # noqa: F401
)

EXAMPLES = Path(__file__).parents[2] / "examples"
DESKTOP = {"width": 1280, "height": 900}
PHONE = {"width": 390, "height": 844}

_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Without a screen there is no graphics card either; what is drawn is computed.
_ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_PATIENCE_MS = 30_000.0


@dataclass
class Visit:
    """A page in the browser, with what went wrong in it."""

    page: Page
    client: httpx.Client
    faults: list[str] = field(default_factory=list)

    def open(self, path: str = "/") -> Page:
        """Load a page of the service."""
        self.page.goto(str(self.client.base_url).rstrip("/") + path)
        return self.page

    def open_example(self) -> Page:
        """The start page, when the example's photographs are there and one is shown."""
        page = self.open()
        expect(page.locator("#photo-strip li")).to_have_count(4)
        # The viewer sets its shape when it has loaded the photograph.
        expect(page.locator(".stage")).to_have_attribute("data-shape", re.compile("around|whole"))
        return page

    def find(self) -> Page:
        """Ask about the photograph that is chosen, and wait for the answer."""
        self.page.get_by_role("button", name="Find the place").click()
        expect(self.page.locator("#answer")).to_be_visible()
        return self.page


# Not for the session: while it is there, no other test can run an event loop.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Chromium, as it is installed here."""
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        pytest.skip("no browser is installed; on Debian and Ubuntu: apt-get install chromium")
    expect.set_options(timeout=_PATIENCE_MS)
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=found, args=_ARGUMENTS)
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def service(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:  # noqa: F811
    """An app without plans, for the tests of a module."""
    with start_app(tmp_path_factory.mktemp("data")) as client:
        yield client


def _context(browser: Browser, **options: Any) -> BrowserContext:
    values: dict[str, Any] = {"viewport": DESKTOP} | options
    context = browser.new_context(**values)
    context.set_default_timeout(_PATIENCE_MS)
    return context


def visit(browser: Browser, client: httpx.Client, **options: Any) -> Iterator[Visit]:
    """A new visitor; what the browser complains about fails the test.

    Args:
        options: of the browser's context, such as `viewport` or `color_scheme`.
    """
    with _context(browser, **options) as context:
        visited = Visit(context.new_page(), client)

        def heard(message: ConsoleMessage) -> None:
            # Refused requests are told as errors as well; what they mean is shown on the page.
            if message.type in ("error", "warning") and "Failed to load resource" not in message.text:
                visited.faults.append(message.text)

        visited.page.on("console", heard)
        visited.page.on("pageerror", lambda error: visited.faults.append(str(error)))
        yield visited
    assert [fault for fault in visited.faults if "GPU stall" not in fault and "swiftshader" not in fault.lower()] == []


@pytest.fixture
def desktop(browser: Browser, service: httpx.Client) -> Iterator[Visit]:
    """A visitor at a desk."""
    yield from visit(browser, service)


@pytest.fixture
def phone(browser: Browser, service: httpx.Client) -> Iterator[Visit]:
    """A visitor with a phone."""
    yield from visit(browser, service, viewport=PHONE, has_touch=True, is_mobile=True, device_scale_factor=2)
