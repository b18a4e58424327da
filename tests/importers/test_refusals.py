"""Refusals of damaged files of all formats: in the words of the format, without those of a library."""

from __future__ import annotations

import io
import json
import random
import re
from collections.abc import Iterator
from unittest.mock import Mock

import cv2
import pypdfium2
import pytest
from PIL import Image, ImageOps

from benchmarks.hostile_drawings import HOSTILE_PLANS, ifc_space, pdf
from benchmarks.hostile_files import boxes, chords
from benchmarks.plan_drawing import STYLES, draw_plan
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers import EXPORT_FORMATS, FORMATS, ImportOptions, export_plan, import_plans
from tests.importers.conftest import FLAT
from tests.painted import picture_file

# Addresses, objects, tracebacks, names of libraries and of their errors, and the same word twice.
INTERNAL = re.compile(
    r"0x[0-9a-f]{6,}|<[\w.]+ object|<_io|Traceback|File \"|\bNone\b|#None|codec|errno"
    r"|shapely|geos|ezdxf|pdfium|\bPIL\b|pillow|ifcopenshell|svgelements|expat|numpy|cv2|opencv|pyproj|zlib|pickle"
    r"|[a-z]Error\b|Exception|Forbidden\(|bad_alloc|index out of range|object is not|the (\w+) of the \1\b",
    re.IGNORECASE,
)
_SCALE = ImportOptions(metres_per_pixel=0.02)
_OWN = {"roomplan": "floors that coincide", "osm": "rooms that coincide", "indoorgml": "faces that coincide"}


def _whole(format: str) -> bytes:
    """Return a small file of a format."""
    if format in EXPORT_FORMATS:
        return export_plan(FloorPlan.from_dict(json.loads(json.dumps(FLAT))), format, Anchor(48.0, 11.0, None, 0.0))
    if format in _OWN:
        return next(p for p in HOSTILE_PLANS if (p.format, p.title) == (format, _OWN[format])).make(2000)
    if format == "ifc":
        return ifc_space(boxes(1)[0])
    if format == "pdf":
        return pdf(b"".join(b"%.2f %.2f m %.2f %.2f l S\n" % (*a, *b) for a, b in chords(20, 700.0)))
    if format == "dwg":
        return b"AC1032" + bytes(range(250))
    return picture_file(Image.new("L", (80, 80), 255))


def _damaged(content: bytes, count: int) -> Iterator[bytes]:
    """Yield a file cut, with bytes that are no text, with changed bytes, and with other numbers."""
    rng = random.Random(len(content))
    for _ in range(count):
        place = rng.randrange(8, len(content) - 4)
        yield content[:place]
        yield content[:place] + b"\xff\xfe" + content[place + 2 :]
        changed = bytearray(content)
        for k in rng.sample(range(8, len(content)), min(5, len(content) - 8)):
            changed[k] = rng.randrange(256)
        yield bytes(changed)
        numbers = list(re.finditer(rb"\d+(\.\d+)?", content))
        if numbers:
            match = rng.choice(numbers)
            other = rng.choice([b"1e308", b"-1e999", b"nan", b"9" * 400, b"", b"x", b"null", b"[]", b"1e-320"])
            yield content[: match.start()] + other + content[match.end() :]


def _refusal(content: bytes, options: ImportOptions) -> str:
    try:
        import_plans(content, options)
    except InvalidInputError as error:
        return str(error)
    return ""


# Variants of a PDF take seconds.
@pytest.mark.parametrize(
    "format", [pytest.param(format, marks=[pytest.mark.slow] if format == "pdf" else []) for format in FORMATS]
)
def test_refusal_has_no_words_of_a_library(format: str):
    if format == "ifc":
        pytest.importorskip("ifcopenshell")
    content = _whole(format)
    options = _SCALE if format in ("picture", "pdf") else ImportOptions()
    count = 4 if format in ("pdf", "dxf", "ros") else 12
    messages = [message for damaged in _damaged(content, count) if (message := _refusal(damaged, options))]
    assert messages
    assert [message for message in messages if INTERNAL.search(message)] == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x89PNG\r\n\x1a\n damaged", "the picture is damaged"),
        (b'{"type": "Polygon", "coordinates": "x"}', "the geometry of the file is not a GeoJSON geometry"),
        (b'{"name": "\xff", "rooms": []}', "byte 10 of the text is not UTF-8"),
        (b"PK\x03\x04 damaged", "the archive is damaged"),
        (b"%PDF-1.7 damaged", "the PDF cannot be read: it is damaged or encrypted"),
        (b'<?xml version="1.0"?><svg><g></svg>', "not well-formed in line 1, column"),
    ],
)
def test_damage_is_named(content: bytes, words: str):
    with pytest.raises(InvalidInputError, match=words) as caught:
        import_plans(content, _SCALE)
    assert INTERNAL.search(str(caught.value)) is None


def test_page_that_is_painted_over_and_over_is_refused_before_it_is_rendered(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pypdfium2.PdfPage, "render", pytest.fail)
    with pytest.raises(InvalidInputError, match="cover it more than 1000 times"):
        import_plans(pdf(b"0 0 800 800 re f " * 1100), _SCALE)


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=[pytest.mark.slow] * (seed > 1)) for seed in range(10)])
def test_changed_picture_of_a_plan_is_read_or_refused(seed: int):
    chance = random.Random(seed)
    page = Image.open(io.BytesIO(draw_plan(STYLES[seed % len(STYLES)], seed).png())).convert("RGB")
    side = chance.choice([300, 500, 700])
    page.thumbnail((side, side))
    page = page.rotate(chance.choice([0.0, 90.0, chance.uniform(-180.0, 180.0)]), expand=True, fillcolor="white")
    page = page.crop((chance.randint(0, page.width // 3), 0, page.width, chance.randint(page.height // 2, page.height)))
    page = ImageOps.invert(page) if seed % 2 else Image.open(io.BytesIO(picture_file(page, "JPEG", quality=8)))
    if seed % 3 == 0:
        page.putalpha(ImageOps.invert(page.convert("L")))
    try:
        import_plans(picture_file(page), ImportOptions(metres_per_pixel=chance.choice([None, 0.01, 0.03])))
    except InvalidInputError as error:
        assert not INTERNAL.search(str(error))  # noqa: PT017


def test_error_of_a_step_on_a_picture_is_a_refusal(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cv2, "threshold", Mock(side_effect=cv2.error("OpenCV: Assertion failed in function 'resize'")))
    with pytest.raises(InvalidInputError, match=r"the picture of 'house' cannot be read.* check the scale") as caught:
        import_plans(_whole("picture"), _SCALE, building="house")
    assert INTERNAL.search(str(caught.value)) is None
