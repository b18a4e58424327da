"""Of how many segments or chunks a picture's file is put together, counted before anything is made of them.

Reading a piece takes microseconds, so millions of empty ones keep a reader busy for as long as decoding would; pieces
of Exif are put together one by one, in time that grows with the square of their number.
"""

from __future__ import annotations

from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.panorama import jpeg

# Of 64 KiB at most each: more than any metadata need. Cameras write one piece of Exif, or a few.
_MAX_SEGMENTS, _MAX_EXIF_SEGMENTS = 2_000, 16
# Encoders write pixels in pieces of 8 KiB and more.
_MAX_CHUNKS = 20_000
_PNG = b"\x89PNG\r\n\x1a\n"
# Length before, checksum after each.
_CHUNK_FRAME = 12


def check_segments(content: bytes) -> None:
    """Refuse a JPEG or PNG of too many pieces; anything else is left to others.

    Raises:
        InvalidPanoramaError: it has more than any encoder writes.
    """
    if content.startswith(jpeg.START):
        _check_jpeg(content)
    elif content.startswith(_PNG):
        _check_png(content)


def _check_jpeg(content: bytes) -> None:
    """Those before the first scan, which are read when a JPEG is opened."""
    exif = 0
    for segments, (marker, at) in enumerate(jpeg.markers(content), start=1):
        if marker == jpeg.START_OF_SCAN:
            return
        exif += marker == jpeg.APP1 and content.startswith(b"Exif\0\0", at + 2)
        if segments > _MAX_SEGMENTS:
            raise InvalidPanoramaError(f"the panorama is a JPEG of more than {_MAX_SEGMENTS} segments")
        if exif > _MAX_EXIF_SEGMENTS:
            raise InvalidPanoramaError(f"the panorama is a JPEG with more than {_MAX_EXIF_SEGMENTS} segments of Exif")


def _check_png(content: bytes) -> None:
    chunks, at = 0, len(_PNG)
    while at < len(content):
        chunks += 1
        at += _CHUNK_FRAME + int.from_bytes(content[at : at + 4], "big")
        if chunks > _MAX_CHUNKS:
            raise InvalidPanoramaError(f"the panorama is a PNG of more than {_MAX_CHUNKS} chunks")
