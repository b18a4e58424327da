"""Untrusted plans and pictures are read in linear time."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress

import pytest
from PIL import Image

from lalaloc_core.errors import InvalidFloorPlanError, InvalidPanoramaError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.panorama.images import open_panorama
from lalaloc_core.panorama.photo_sphere import read_photo_sphere
from lalaloc_core.panorama.segments import check_segments
from tests.growth import assert_no_worse_than_linear

_PACKET = 60_000
_GPANO = b"http://ns.google.com/photos/1.0/panorama/"


@pytest.mark.parametrize(
    "text",
    [
        lambda size: '"' + '\\"' * size,
        lambda size: '"' + "\\" * size,
        lambda size: '"' * size,
        lambda size: "[" * size,
        lambda size: "{" * size + "}" * size,
        lambda size: "9" * size,
        lambda size: "[0." + "9" * size + "]",
        lambda size: "{" + ",".join(f'"{k}":0' for k in range(size // 4)) + "}",
        lambda size: '{"rooms": [' + ",".join(['{"polygon": 0}'] * (size // 8)) + "]}",
        lambda size: '{"name": "' + "x" * size + '"}',
        lambda size: '{"ceiling_height_m": 2.5, "rooms": [{"polygon": [' + ",".join(["[0,0]"] * (size // 4)) + "]}]}",
        lambda size: " " * size,
        lambda size: "\ufeff" * size,
    ],
    ids=[
        "escaped quotes",
        "backslashes",
        "quotes",
        "lists",
        "objects",
        "digits",
        "decimals",
        "keys",
        "rooms",
        "name",
        "vertices",
        "blanks",
        "marks",
    ],
)
def test_invalid_plan_is_refused_in_linear_time(text: Callable[[int], str]) -> None:
    def refuse(size: int) -> Callable[[], None]:
        content = text(size).encode()

        def work() -> None:
            with pytest.raises(InvalidFloorPlanError):
                FloorPlan.from_json(content)

        return work

    assert_no_worse_than_linear(refuse, 20_000)


@pytest.mark.parametrize(
    "packet",
    [
        lambda size: b"<a>" * (size // 7) + b"</a>" * (size // 7),
        lambda size: b"<a>" + b"<b/>" * (size // 4) + b"</a>",
        lambda size: b"<a " + b" ".join(b'a%d="1"' % k for k in range(size // 10)) + b"/>",
        lambda size: b"".join(b'<a xmlns="u%d">' % k for k in range(size // 20)) + b"</a>" * (size // 20),
        lambda size: b"<a>" + b"&amp;" * (size // 5) + b"</a>",
        lambda size: b"<a>" + b"<![CDATA[x]]>" * (size // 13) + b"</a>",
        lambda size: b"<" + b"a" * size + b"/>",
        lambda size: b'<a x="' + b"x" * size,
        lambda size: b"<!--" + b"-" * size,
        lambda size: b'<a xmlns:g="' + _GPANO + b'" g:PosePitchDegrees="' + b"9" * size + b'"/>',
    ],
    ids=["deep", "wide", "attributes", "namespaces", "entities", "cdata", "name", "open", "comment", "digits"],
)
def test_metadata_are_read_in_linear_time(packet: Callable[[int], bytes]) -> None:
    def read(size: int) -> Callable[[], object]:
        content = packet(size)
        return lambda: read_photo_sphere(content, width=512, height=256)

    assert_no_worse_than_linear(read, _PACKET)


def _picture(name: str) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (256, 128), (90, 90, 90)).save(buffer, name)
    return buffer.getvalue()


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


_PIECES = {
    "comments": ("JPEG", 2, _segment(0xFE, b"")),
    "exif": ("JPEG", 2, _segment(0xE1, b"Exif\0\0x")),
    "xmp": ("JPEG", 2, _segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0<a/>")),
    "profiles": ("JPEG", 2, _segment(0xE2, b"ICC_PROFILE\0\1\1x")),
    "fill bytes": ("JPEG", 2, b"\xff"),
    "texts": ("PNG", 33, _chunk(b"tEXt", b"a\0b")),
    "unknown chunks": ("PNG", 33, _chunk(b"abCd", b"")),
}


@pytest.mark.parametrize("kind", _PIECES)
def test_many_segments_are_read_in_linear_time(kind: str) -> None:
    name, offset, piece = _PIECES[kind]
    plain = _picture(name)

    def read(count: int) -> Callable[[], None]:
        content = plain[:offset] + piece * count + plain[offset:]

        def work() -> None:
            with suppress(InvalidPanoramaError):
                open_panorama(content, height=32, width=64)

        return work

    assert_no_worse_than_linear(read, 1_000 if name == "JPEG" else 15_000)


def test_million_segments_are_refused_early() -> None:
    jpeg, png = _picture("JPEG"), _picture("PNG")
    for piece, message in ((_segment(0xFE, b""), "2000 segments"), (_segment(0xE1, b"Exif\0\0x"), "16 Exif segments")):
        with pytest.raises(InvalidPanoramaError, match=message):
            open_panorama(jpeg[:2] + piece * 1_000_000 + jpeg[2:], height=32, width=64)
    for piece in (_chunk(b"tEXt", b"a\0b"), _chunk(b"IDAT", b"")):
        with pytest.raises(InvalidPanoramaError, match="20000 chunks"):
            open_panorama(png[:33] + piece * 1_000_000 + png[33:], height=32, width=64)


def test_usual_segment_counts_are_accepted() -> None:
    jpeg, png = _picture("JPEG"), _picture("PNG")
    # 40 MB of metadata in the largest possible segments, and pixels in the smallest chunks that encoders write.
    check_segments(jpeg[:2] + _segment(0xE2, bytes(65_000)) * 640 + jpeg[2:])
    check_segments(png[:33] + _chunk(b"IDAT", bytes(4096)) * 10_000)
    for content in (jpeg, png, _picture("WEBP"), b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n"):
        check_segments(content)
