"""How often a JPEG goes over its pixels: the scans of a progressive one, counted without decoding any."""

from __future__ import annotations

import re

_START = b"\xff\xd8"
_END_OF_IMAGE, _START_OF_SCAN = 0xD9, 0xDA
# Alone, without a length: restarts and TEM.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
# As libjpeg looks for the next marker: any number of 0xFF before it, and in a scan's data 0xFF 0x00 is none.
_MARKER = re.compile(rb"\xff([^\x00\xff])")


def count_scans(content: bytes, most: int) -> int:
    """The scans of a JPEG up to its end, counted no further than `most` + 1; 0 for what is no JPEG.

    A scan of a few bytes makes the decoder go over every block of the picture again, so a small file may keep it busy
    for minutes. One pass over the bytes, as far as the decoder would read them: what comes after the end of the
    picture, such as the video of a moving photograph, is not looked at.
    """
    if not content.startswith(_START):
        return 0
    scans, at = 0, len(_START)
    while scans <= most and (found := _MARKER.search(content, at)) is not None:
        marker, at = found[1][0], found.end()
        if marker == _END_OF_IMAGE:
            break
        scans += marker == _START_OF_SCAN
        if marker not in _ALONE:
            at += int.from_bytes(content[at : at + 2], "big")
    return scans
