"""Draw the pictures of pages that README.md shows: a phone photograph of a real room with the reason for its answer,
and a pinned folder.

    python -m scripts.draw_pages docs/images

The photographs are cut from the example spheres. Needs Chromium and the extra `dev`.
"""

from __future__ import annotations

import io
import math
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from playwright.sync_api import Page, ViewportSize, expect, sync_playwright

from benchmarks.harness import argument_parser, started_service
from examples.truth import FOLDER, PLAN_PATH
from lalaloc_core.learn.data.views import cut_view
from lalaloc_core.photograph.cameras import Perspective

_ROOMS = ("living_room", "kitchen", "bedroom", "study")
_AZIMUTHS_DEG, _PITCH = (-100.0, 20.0, 140.0), math.radians(-3.0)
# A phone's wide lens in a real bedroom (CC0, examples/real).
_REAL, _REAL_AZIMUTH_DEG, _REAL_FIELD_DEG = "real/lythwood_room", 30.0, 100.0
_FOCAL_LENGTH_35MM, _TAKEN = 0xA405, 0x9003
_SIZE: ViewportSize = {"width": 1280, "height": 860}
_HIGH, _NOTE_MS = 1120, 10_000.0
_WAIT_MS = 180_000.0
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("out", type=Path, help="folder to write JPEGs into")
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as data, started_service(Path(data)) as service, sync_playwright() as playwright:
        path = next(filter(None, map(shutil.which, _BROWSERS)))
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        for draw in (_real_phone, _pinned_folder):
            page = browser.new_page(viewport=_SIZE)
            page.set_default_timeout(_WAIT_MS)
            draw(page, service.url, service.data)
            with Image.open(io.BytesIO(page.screenshot())) as image:
                image.convert("RGB").save(out / f"{draw.__name__.strip('_')}.jpg", quality=90, optimize=True)
            page.close()
        browser.close()
    return 0


def _real_phone(page: Page, url: str, folder: Path) -> None:
    photograph = _photograph(_REAL, _REAL_AZIMUTH_DEG, _REAL_FIELD_DEG, folder / "bedroom.jpg")
    page.set_viewport_size({"width": _SIZE["width"], "height": _HIGH})
    page.goto(url)
    page.locator("#plan-file").set_input_files(FOLDER / "real" / "rooms.json")
    expect(page.locator("#plan-name")).to_contain_text("photographed rooms")
    page.locator("#photo-file").set_input_files(photograph)
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#answer")).to_contain_text("Looks like", timeout=_WAIT_MS)
    # The note about the stored plan goes.
    page.wait_for_timeout(_NOTE_MS)


def _pinned_folder(page: Page, url: str, folder: Path) -> None:
    files = [
        _photograph(room, azimuth_deg, 90.0, folder / f"IMG_{2041 + number}.jpg", minute=number)
        for number, (room, azimuth_deg) in enumerate((room, azimuth) for room in _ROOMS for azimuth in _AZIMUTHS_DEG)
    ]
    page.goto(f"{url}/pin")
    page.locator("#plan-file").set_input_files(PLAN_PATH)
    expect(page.locator("#plan .room").first).to_be_visible()
    page.locator("#photo-files").set_input_files(files)
    expect(page.locator("#pin-state")).to_contain_text("(solved)", timeout=_WAIT_MS)
    expect(page.locator(".card img")).to_have_count(len(files), timeout=_WAIT_MS)
    page.locator(".card").first.focus()


def _photograph(name: str, azimuth_deg: float, field_deg: float, path: Path, minute: int = 0) -> Path:
    """Cut a photograph from an example sphere, with the time and the focal length of its camera."""
    with Image.open(FOLDER / f"{name}.jpg") as picture:
        sphere = np.asarray(picture.convert("RGB"))
    camera = Perspective.of_hfov(800, 600, math.radians(field_deg))
    view = cut_view(sphere, camera, azimuth=math.radians(azimuth_deg), pitch=_PITCH, roll=0.0)
    exif = Image.Exif()
    focal_mm = round(18.0 / math.tan(math.radians(field_deg / 2.0)))
    tags = {_FOCAL_LENGTH_35MM: focal_mm, _TAKEN: f"2026:05:01 10:{minute:02}:00"}
    exif.get_ifd(ExifTags.IFD.Exif).update(tags)
    Image.fromarray(view).save(path, quality=92, exif=exif)
    return path


if __name__ == "__main__":
    sys.exit(main())
