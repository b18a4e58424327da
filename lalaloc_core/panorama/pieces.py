"""Of how many pieces a picture's file is put together, counted before anything is made of them.

Reading a piece takes microseconds, so millions of empty ones keep a reader busy for as long as decoding would; pieces
of Exif are put together one by one, in time that grows with the square of their number.
"""

from __future__ import annotations

import re

from lalaloc_core.errors import InvalidPanoramaError

# Of 64 KiB at most each: more than any metadata need. Cameras write one piece of Exif, or a few.
_MAX_SEGMENTS, _MAX_EXIF_SEGMENTS = 2_000, 16
# Encoders write pixels in pieces of 8 KiB and more.
_MAX_CHUNKS = 20_000
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_APP1, _END_OF_IMAGE, _START_OF_SCAN = 0xE1, 0xD9, 0xDA
# Alone, without a length.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
_MARKER = re.compile(rb"\xff([^\x00\xff])")
# Length before, checksum after each.
_CHUNK_FRAME = 12


def check_pieces(content: bytes) -> None:
    """Refuse a JPEG or PNG of too many pieces; anything else is left to others.

    Raises:
        InvalidPanoramaError: it has more than any encoder writes.
    """
    if content.startswith(_JPEG):
        _check_segments(content)
    elif content.startswith(_PNG):
        _check_chunks(content)


def _check_segments(content: bytes) -> None:
    """Those before the first scan, which are read when a JPEG is opened."""
    segments = exif = 0
    at = len(_JPEG)
    while (found := _MARKER.search(content, at)) is not None:
        marker, at = found[1][0], found.end()
        if marker in (_START_OF_SCAN, _END_OF_IMAGE):
            return
        segments += 1
        if marker not in _ALONE:
            exif += marker == _APP1 and content.startswith(b"Exif\0\0", at + 2)
            at += int.from_bytes(content[at : at + 2], "big")
        if segments > _MAX_SEGMENTS:
            raise InvalidPanoramaError(f"the panorama is a JPEG of more than {_MAX_SEGMENTS} segments")
        if exif > _MAX_EXIF_SEGMENTS:
            raise InvalidPanoramaError(f"the panorama is a JPEG with more than {_MAX_EXIF_SEGMENTS} segments of Exif")


def _check_chunks(content: bytes) -> None:
    chunks, at = 0, len(_PNG)
    while at < len(content):
        chunks += 1
        at += _CHUNK_FRAME + int.from_bytes(content[at : at + 4], "big")
        if chunks > _MAX_CHUNKS:
            raise InvalidPanoramaError(f"the panorama is a PNG of more than {_MAX_CHUNKS} chunks")
