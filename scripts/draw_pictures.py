"""Draw all pictures that README.md and docs/ show into docs/images: `make pictures`. Needs Chromium.

`drawn.json` there has the digests of the pictures and of what they show; the tests fail when that has changed. The
photographs are cut from the example spheres.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import json
import math
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image
from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.harness import started_service
from examples.truth import FOLDER, PLAN_PATH
from lalaloc_core import LaLaLoc, StatedCamera, read_plan
from lalaloc_core.cli import main as lalaloc
from lalaloc_core.draw.answer import draw_answer, drawn_answer
from lalaloc_core.draw.canvas import MUTED, document, image, pixels, words
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.photograph.spheres import level
from lalaloc_core.shown_text import probability_text

ROOT = FOLDER.parent
IMAGES = ROOT / "docs" / "images"
# Beginnings of the names of built files that change no look; documentation and comments of Python.
_UNSEEN = ("built.json", "client.js", "docs.", "on_device.js", "onnxruntime.", "swagger-ui")
_UNSEEN_TEXT = re.compile(rb'(?s:""".*?""")|(?<=\s)# .*')

# Pictures that the documentation's commands write, with their names here and their widths (pixels).
_WRITTEN = (("flat.png", "plan", 600), ("answer.png", "answer", 900), ("real.png", "real_answer", 1000))
_ROOMS, _AZIMUTHS_DEG = ("living_room", "kitchen", "bedroom", "study"), (-100.0, 20.0, 140.0)
_FOCAL_LENGTH_35MM, _TAKEN, _WAIT_MS = 0xA405, 0x9003, 180_000.0
# WebGL in software, for the sphere on the page.
_ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# A turn: number, field of view and size of its photographs; width and gaps of its picture (pixels).
_COUNT, _FIELD_DEG, _TURN_SIZE, _WIDTH, _GAP = 12, 53.0, (360, 480), 1200, 12


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        _draw_pages(Path(folder))
        _draw_answers(Path(folder))
    _draw_turn()
    _draw_spheres()
    drawn = {"pictures": pictures(), "shown": shown()}
    (IMAGES / "drawn.json").write_text(json.dumps(drawn, indent=1) + "\n", encoding="utf-8")


def pictures() -> dict[str, str]:
    return {path.name: _digest([path]) for path in sorted(IMAGES.glob("*.jpg"))}


def shown() -> dict[str, str]:
    """Return the digests of what the pictures show."""
    pages = [path for path in (ROOT / "service" / "web").iterdir() if not path.name.startswith(_UNSEEN)]
    return {
        "service/web": _digest(pages),
        "lalaloc_core/draw": _digest((ROOT / "lalaloc_core" / "draw").glob("*.py")),
        "models/default": _digest([ROOT / "models" / "default" / "manifest.json"]),
        "examples": _digest([PLAN_PATH, *FOLDER.glob("*.jpg"), *FOLDER.glob("real/*")]),
    }


def _digest(paths: Iterable[Path]) -> str:
    """Return the digest of files with their names, except for white space, documentation and comments."""
    total = hashlib.sha256()
    for path in sorted(paths):
        content = path.read_bytes()
        seen = _UNSEEN_TEXT.sub(b"", content) if path.suffix == ".py" else content
        total.update(path.name.encode() + b" ".join(seen.split()))
    return total.hexdigest()


def _save(picture: Image.Image, name: str, width: int = 0) -> None:
    size = width or picture.width, round(picture.height * (width or picture.width) / picture.width)
    scaled = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    scaled.save(IMAGES / f"{name}.jpg", quality=90, optimize=True)


def _draw_pages(folder: Path) -> None:
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        raise SystemExit("Chromium is not installed; on Debian and Ubuntu: apt-get install chromium")
    expect.set_options(timeout=_WAIT_MS)
    # Answers are kept as by `make serve`.
    with started_service(folder, {"LALALOC_KEEP_ANSWERS_S": "86400"}) as service, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS)
        for draw, width, height in ((_page, 1400, 1079), (_real_phone, 1280, 1120), (_pinned_folder, 1280, 860)):
            page = browser.new_page(viewport={"width": width, "height": height})
            draw(page, service.url, folder)
            # Notes about stored plans go.
            expect(page.locator("#toast.shown")).to_have_count(0)
            _save(Image.open(io.BytesIO(page.screenshot(animations="disabled"))), draw.__name__.strip("_"))


def _page(page: Page, url: str, _folder: Path) -> None:
    page.goto(url)
    # The page begins with a turn.
    expect(page.locator("#photo-strip li")).to_have_count(4)
    page.get_by_text("Plans", exact=True).click()
    page.locator("#example-spheres").click()
    expect(page.locator("#photo-strip")).to_contain_text("kitchen.jpg")
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#fit-state")).to_contain_text("Layout as seen from kitchen")


def _real_phone(page: Page, url: str, folder: Path) -> None:
    # A phone's wide lens in a real bedroom (CC0).
    photograph = _photograph("real/lythwood_room", 30.0, 100.0, folder / "bedroom.jpg")
    page.goto(url)
    page.locator("#plan-file").set_input_files(FOLDER / "real" / "rooms.json")
    expect(page.locator("#plan-name")).to_contain_text("photographed rooms")
    page.locator("#photo-file").set_input_files(photograph)
    page.get_by_role("button", name="Find the place").click()
    expect(page.locator("#answer")).to_contain_text("Looks like")


def _pinned_folder(page: Page, url: str, folder: Path) -> None:
    taken = enumerate(itertools.product(_ROOMS, _AZIMUTHS_DEG))
    files = [_photograph(*view, 90.0, folder / f"IMG_{2041 + minute}.jpg", minute) for minute, view in taken]
    page.goto(f"{url}/pin")
    page.locator("#plan-choice").select_option(label="Example flat")
    expect(page.locator("#plan")).to_contain_text("living room")
    page.locator("#photo-files").set_input_files(files)
    expect(page.locator("#pin-state")).to_contain_text("(solved)")
    expect(page.locator(".card img")).to_have_count(len(files))
    page.locator(".card").first.focus()


def _photograph(name: str, azimuth_deg: float, field_deg: float, path: Path, minute: int = 0) -> Path:
    """Cut a photograph from an example sphere, with the time and the focal length of its camera."""
    camera = Perspective.of_hfov(800, 600, math.radians(field_deg))
    view = cut_view(_sphere(name), camera, azimuth=math.radians(azimuth_deg), pitch=math.radians(-3.0), roll=0.0)
    focal_mm, exif = round(18.0 / math.tan(math.radians(field_deg / 2.0))), Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({_FOCAL_LENGTH_35MM: focal_mm, _TAKEN: f"2026:05:01 10:{minute:02}:00"})
    Image.fromarray(view).save(path, quality=92, exif=exif)
    return path


def _sphere(name: str) -> UInt8[np.ndarray, "h w 3"]:
    with Image.open(FOLDER / f"{name}.jpg") as picture:
        return np.asarray(picture.convert("RGB"))


def _draw_answers(folder: Path) -> None:
    """Run the commands of the tutorial, and that of README.md in a photographed room."""
    (folder / "examples").symlink_to(FOLDER)
    commands = []
    for page, last in (("docs/getting-started.md", r"\S+"), ("README.md", r"real\.png")):
        text = (ROOT / page).read_text(encoding="utf-8")
        commands += re.findall(rf"^\.venv/bin/lalaloc (.* --out {last})$", text, re.MULTILINE)
    with contextlib.chdir(folder):
        for command in commands:
            if lalaloc(shlex.split(command)) != 0:
                raise SystemExit(f"`lalaloc {command}` failed")
        for file, name, width in _WRITTEN:
            _save(Image.open(file), name, width)


def _draw_turn() -> None:
    """Draw the photographs of a turn of a phone above its place by the first one alone and by all."""
    sphere, camera = _sphere("bedroom"), Perspective.of_hfov(*_TURN_SIZE, math.radians(_FIELD_DEG))
    azimuths = [math.tau * number / _COUNT for number in range(_COUNT)]
    files = [encode_jpeg(cut_view(sphere, camera, azimuth=azimuth, pitch=0.0, roll=0.0)) for azimuth in azimuths]
    model, plan, stated = LaLaLoc(), read_plan(PLAN_PATH), StatedCamera(projection="perspective", hfov_deg=_FIELD_DEG)
    answers = {
        "The first photograph alone": model.localise(plan, files[0], camera=stated),
        f"All {_COUNT}, taken while turning": model.localise_turn(plan, files, camera=stated),
    }
    step, half = ((_WIDTH - _GAP) / count for count in (_COUNT, len(answers)))
    tall, below = (step - _GAP) * _TURN_SIZE[1] / _TURN_SIZE[0], 0.0
    parts = [image(file, "jpeg", (_GAP + number * step, _GAP, step - _GAP, tall)) for number, file in enumerate(files)]
    for number, (text, answer) in enumerate(answers.items()):
        left, top = _GAP + number * half, 2 * _GAP + tall
        confidence = probability_text(answer.confidence or 0.0, 0)
        parts.append(words(left, top + 26, f"{text}: confidence {confidence}", 20, fill=MUTED))
        drawn = pixels(draw_answer(drawn_answer(answer), None, "plan"))
        box = (left, top + 40, half - _GAP, (half - _GAP) * drawn.height / drawn.width)
        parts.append(image(encode_jpeg(np.asarray(drawn)), "jpeg", box))
        below = box[1] + box[3] + _GAP
    _save(pixels(document(_WIDTH, round(below), "A turn on the spot and its place", parts)), "turn")


def _draw_spheres() -> None:
    """Draw a sphere that can be used, one of a leaning camera, and a strip of a phone's panorama mode."""
    sphere = np.asarray(Image.fromarray(_sphere("kitchen")).resize((768, 384), Image.Resampling.LANCZOS))
    tilted = level(sphere, pitch=math.radians(8.0), roll=math.radians(6.0))
    for name, seen in (("sphere", sphere), ("tilted", tilted), ("phone", sphere[128:256, :512])):
        _save(Image.fromarray(np.ascontiguousarray(seen)), name)


if __name__ == "__main__":
    main()
