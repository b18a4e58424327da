"""Files that are made to exhaust or to reach out: every one is refused, quickly, with what is wrong."""

from __future__ import annotations

import io
import itertools
import json
import pickle
import struct
import zipfile
import zlib

import pytest
from ezdxf.filemanagement import new as new_dxf
from PIL import Image

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import ImportLimits, ImportOptions, detect_format, import_plans
from tests.plans.conftest import FLAT

SVG = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">{}</svg>'


def _refused(content: bytes, message: str, **limits: object) -> None:
    with pytest.raises(InvalidFloorPlanError, match=message):
        import_plans(content, ImportOptions(metres_per_pixel=0.01), ImportLimits(**limits))  # type: ignore[arg-type]


def test_entities_that_multiply():
    lol = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    _refused(f'<!DOCTYPE svg [<!ENTITY l0 "lol">{lol}]>{SVG.format("<text>&l9;</text>")}'.encode(), "declares entities")


def test_entities_of_other_files():
    document = f'<!DOCTYPE svg [<!ENTITY x SYSTEM "file:///etc/passwd">]>{SVG.format("<text>&x;</text>")}'
    _refused(document.encode(), "entities")


def test_external_doctypes():
    document = f'<!DOCTYPE svg SYSTEM "http://127.0.0.1:1/x.dtd">{SVG.format("")}'
    _refused(document.encode(), "refers to other files|no room")


def test_uses_that_multiply():
    uses = [f'<use xlink:href="#g{i - 1}"/>' * 10 for i in range(1, 12)]
    groups = "".join(f'<g id="g{i}">{use}</g>' for i, use in enumerate(uses, 1))
    _refused(SVG.format(f'<rect id="g0" width="1" height="1"/>{groups}').encode(), "entities")


def test_a_use_of_itself():
    _refused(SVG.format('<g id="a"><use href="#a"/></g>').encode(), "draws itself")


def test_elements_in_elements():
    _refused(SVG.format("<g>" * 500 + "</g>" * 500).encode(), "nested more than")


def test_deep_json():
    _refused(("[" * 100_000 + "]" * 100_000).encode(), "nested")


def test_a_zip_that_unpacks_to_more_than_it_may():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("unit.geojson", b" " * 3_000_000)
    assert len(stream.getvalue()) < 10_000
    _refused(stream.getvalue(), "unpacks to more than", max_unpacked_bytes=1_000_000)


def test_a_zip_that_lies_about_its_sizes():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("unit.geojson", b" " * 3_000_000)
    content = stream.getvalue().replace(struct.pack("<I", 3_000_000), struct.pack("<I", 10))
    _refused(content, "damaged|unpacks|JSON", max_unpacked_bytes=1_000_000)


def test_a_zip_of_too_many_files_and_one_with_a_password():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for number in range(300):
            archive.writestr(f"{number}.geojson", b"{}")
    _refused(stream.getvalue(), "300 files")
    content = bytearray()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("unit.geojson", b"{}")
    content += stream.getvalue()
    # The bit that says "encrypted", in the file's own header and in the directory.
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    _refused(bytes(content), "encrypted")


def test_blocks_that_multiply():
    document = new_dxf()
    document.blocks.new("B0").add_line((0, 0), (1, 1))
    for level in range(1, 8):
        block = document.blocks.new(f"B{level}")
        for x in range(10):
            block.add_blockref(f"B{level - 1}", (x, 0))
    document.modelspace().add_blockref("B7", (0, 0), dxfattribs={"row_count": 100, "column_count": 100})
    text = io.StringIO()
    document.write(text)
    _refused(text.getvalue().encode(), "entities")


def test_a_picture_of_too_many_pixels():
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    content = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    _refused(content, "pixels|cannot be read")


def test_a_picture_that_is_cut_off():
    stream = io.BytesIO()
    Image.new("L", (200, 200), 255).save(stream, "PNG")
    _refused(stream.getvalue()[:90], "cannot be read")


def test_more_bytes_than_allowed():
    _refused(b"{" + b" " * 200, "at most 100 are read", max_plan_bytes=100)


def test_an_import_that_takes_too_long():
    ticks = itertools.count(0.0, 10.0)
    with pytest.raises(InvalidFloorPlanError, match="takes more than 30 s"):
        import_plans(json.dumps(FLAT).encode(), clock=lambda: next(ticks) * 10.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello there", "no known format"),
        (b"AC1032 dwg", "DWG: save it as DXF"),
        (b"GIF89a", "GIF: save it as PNG"),
        (b"<html></html>", "no SVG"),
        (b"[1, 2]", "the JSON is a list"),
        (b"%PDF-1.7 nothing", "cannot be read"),
        (b"ISO-10303-21; nothing", "cut off"),
        (b"ISO-10303-21; nothing END-ISO-10303-21;", "cannot be read|no IfcSpace|schema"),
        (b"  0\nSECTION\n nothing", "cannot be read|no lines"),
        (b"PK\x03\x04 nothing", "damaged"),
        (b"\xff\xd8\xff nothing", "cannot be read"),
    ],
)
def test_what_is_no_plan_is_named(content: bytes, message: str):
    _refused(content, message)


def test_the_format_is_told_by_content():
    assert detect_format(b'\xef\xbb\xbf {"rooms": []}') == "native"
    assert detect_format(b'{"type": "Feature"}') == "geojson"
    assert detect_format(b'<?xml version="1.0"?><!-- x --><svg/>') == "svg"
    assert detect_format(b"999\nmade by\n  0\nSECTION\n") == "dxf"
    assert detect_format(b"%PDF-1.4") == "pdf"


def test_plans_travel_between_processes():
    (plan,) = import_plans(json.dumps(FLAT).encode())
    assert pickle.loads(pickle.dumps(plan)).document == plan.document
    assert pickle.loads(pickle.dumps(ImportOptions(scale=100.0))) == ImportOptions(scale=100.0)
