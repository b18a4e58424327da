"""Draw the picture of a pinned folder that README.md shows: the page /pin after a folder of twelve photographs.

    python -m scripts.draw_pinned_folder docs/images/pinned_folder.jpg

The photographs are cut from the example spheres. Needs Chromium and the extra `dev`.
"""

from __future__ import annotations

import argparse
import io
import math
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from playwright.sync_api import expect, sync_playwright

from examples.launch import ROOT, running_service
from examples.truth import FOLDER, PLAN_PATH
from lalaloc_core.learn.data.views import cut_view
from lalaloc_core.photograph.cameras import Perspective

_ROOMS = ("living_room", "kitchen", "bedroom", "study")
_AZIMUTHS_DEG, _PITCH = (-100.0, 20.0, 140.0), math.radians(-3.0)
_CAMERA = Perspective.of_hfov(800, 600, math.radians(90.0))
_FOCAL_LENGTH_35MM, _TAKEN = 0xA405, 0x9003
_WIDTH, _HEIGHT = 1280, 860
_WAIT_MS = 180_000.0
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main() -> int:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="JPEG to write")
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as data:
        files = list(map(str, _photographs(Path(data))))
        environment = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error", "PYTHONPATH": str(ROOT)}
        with running_service(0, environment, ROOT) as service, sync_playwright() as playwright:
            path = next(filter(None, map(shutil.which, _BROWSERS)))
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
            page.set_default_timeout(_WAIT_MS)
            page.goto(f"{service.url}/pin")
            page.locator("#plan-file").set_input_files(PLAN_PATH)
            expect(page.locator("#plan .room").first).to_be_visible()
            page.locator("#photo-files").set_input_files(files)
            expect(page.locator("#pin-state")).to_contain_text("(solved)", timeout=_WAIT_MS)
            expect(page.locator(".card img")).to_have_count(len(files), timeout=_WAIT_MS)
            page.locator(".card").first.focus()
            picture = page.screenshot()
            browser.close()
    with Image.open(io.BytesIO(picture)) as image:
        image.convert("RGB").save(out, quality=90, optimize=True)
    return 0


def _photographs(folder: Path) -> list[Path]:
    paths = []
    for room in _ROOMS:
        with Image.open(FOLDER / f"{room}.jpg") as picture:
            sphere = np.asarray(picture.convert("RGB"))
        for azimuth_deg in _AZIMUTHS_DEG:
            view = cut_view(sphere, _CAMERA, azimuth=math.radians(azimuth_deg), pitch=_PITCH, roll=0.0)
            paths.append(folder / f"IMG_{len(paths) + 2041}.jpg")
            exif = Image.Exif()
            tags = {_FOCAL_LENGTH_35MM: 18, _TAKEN: f"2026:05:01 10:{len(paths):02}:00"}
            exif.get_ifd(ExifTags.IFD.Exif).update(tags)
            Image.fromarray(view).save(paths[-1], quality=92, exif=exif)
    return paths


if __name__ == "__main__":
    sys.exit(main())
