"""Segments, scans and chunks of JPEG and PNG files, counted without decoding, so that costly files are refused early.

Reading a segment takes microseconds, so millions of empty ones keep a reader busy for as long as decoding would. Exif
segments are joined one by one, in time quadratic in their number. Each scan of a JPEG visits all of its pixels again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from lalaloc_core.errors import InvalidPhotographError

START = b"\xff\xd8"
APP1, START_OF_SCAN = 0xE1, 0xDA
_END_OF_IMAGE = 0xD9
# Markers without a length: restarts and TEM.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
# The marker search of libjpeg: any number of 0xFF before it; 0xFF 0x00 in a scan's data is no marker.
_MARKER = re.compile(rb"\xff([^\x00\xff])")
# Segments hold up to 64 KiB, so these are more than any metadata need. Cameras write one segment of Exif, or a few.
_MAX_SEGMENTS, _MAX_EXIF_SEGMENTS = 2_000, 16
# PhotographEncoder write pixels in chunks of 8 KiB and more.
_MAX_CHUNKS = 20_000
_PNG = b"\x89PNG\r\n\x1a\n"
# Length before and checksum after each chunk.
_CHUNK_FRAME = 12


def markers(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield every marker of a JPEG up to its end, as a decoder reads them, and the offset of its segment's length.

    Data after the end of the picture, such as the video of a motion photo, is ignored.
    """
    position = len(START)
    while (found := _MARKER.search(content, position)) is not None:
        marker, position = found[1][0], found.end()
        if marker == _END_OF_IMAGE:
            return
        yield marker, position
        if marker not in _ALONE:
            position += int.from_bytes(content[position : position + 2], "big")


def count_scans(content: bytes, limit: int) -> int:
    """Count the scans of a JPEG, up to `limit` + 1; return 0 for other files.

    A scan of a few bytes makes the decoder visit every block of the picture again, so a small file can keep it busy for
    minutes.
    """
    if not content.startswith(START):
        return 0
    scans = 0
    for marker, _ in markers(content):
        scans += marker == START_OF_SCAN
        if scans > limit:
            break
    return scans


def check_segments(content: bytes) -> None:
    """Refuse a JPEG or PNG with too many segments or chunks; other files pass.

    Raises:
        InvalidPhotographError: the file has more than any encoder writes.
    """
    if content.startswith(START):
        _check_jpeg(content)
    elif content.startswith(_PNG):
        _check_png(content)


def _check_jpeg(content: bytes) -> None:
    """Check the segments before the first scan, which are read when a JPEG is opened."""
    exif = 0
    for segments, (marker, position) in enumerate(markers(content), start=1):
        if marker == START_OF_SCAN:
            return
        exif += marker == APP1 and content.startswith(b"Exif\0\0", position + 2)
        if segments > _MAX_SEGMENTS:
            raise InvalidPhotographError(
                f"the photograph is a JPEG with more than {_MAX_SEGMENTS} segments, the limit; save it again"
            )
        if exif > _MAX_EXIF_SEGMENTS:
            raise InvalidPhotographError(
                f"the photograph is a JPEG with more than {_MAX_EXIF_SEGMENTS} Exif segments, the limit; save it again"
            )


def _check_png(content: bytes) -> None:
    chunks, position = 0, len(_PNG)
    while position < len(content):
        chunks += 1
        position += _CHUNK_FRAME + int.from_bytes(content[position : position + 4], "big")
        if chunks > _MAX_CHUNKS:
            raise InvalidPhotographError(
                f"the photograph is a PNG with more than {_MAX_CHUNKS} chunks, the limit; save it again"
            )
