"""The markers of a JPEG, read without decoding any, and how often it goes over its pixels."""

from __future__ import annotations

import re
from collections.abc import Iterator

START = b"\xff\xd8"
APP1, START_OF_SCAN = 0xE1, 0xDA
_END_OF_IMAGE = 0xD9
# Alone, without a length: restarts and TEM.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
# As libjpeg looks for the next marker: any number of 0xFF before it, and in a scan's data 0xFF 0x00 is none.
_MARKER = re.compile(rb"\xff([^\x00\xff])")


def markers(content: bytes) -> Iterator[tuple[int, int]]:
    """Every marker of a JPEG up to its end, as a decoder would read them, and where its segment begins: at its length.

    What comes after the end of the picture, such as the video of a moving photograph, is not looked at.
    """
    at = len(START)
    while (found := _MARKER.search(content, at)) is not None:
        marker, at = found[1][0], found.end()
        if marker == _END_OF_IMAGE:
            return
        yield marker, at
        if marker not in _ALONE:
            at += int.from_bytes(content[at : at + 2], "big")


def count_scans(content: bytes, most: int) -> int:
    """The scans of a JPEG up to its end, counted no further than `most` + 1; 0 for what is no JPEG.

    A scan of a few bytes makes the decoder go over every block of the picture again, so a small file may keep it busy
    for minutes.
    """
    if not content.startswith(START):
        return 0
    scans = 0
    for marker, _ in markers(content):
        scans += marker == START_OF_SCAN
        if scans > most:
            break
    return scans
