"""Segments, scans and chunks of JPEG and PNG files, read without decoding, so that costly files are refused early.

Reading a segment takes microseconds, so millions of empty ones keep a reader busy for as long as decoding would. Exif
segments are joined one by one, in time quadratic in their number. Each scan of a JPEG visits all of its pixels again.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from itertools import islice, takewhile

from lalaloc_core.errors import InvalidPhotographError

START = b"\xff\xd8"
APP1, START_OF_SCAN = 0xE1, 0xDA
END_OF_IMAGE = 0xD9
END = bytes([0xFF, END_OF_IMAGE])
# Markers without a length: restarts and TEM.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
# The marker search of libjpeg: any number of 0xFF before it; 0xFF 0x00 in a scan's data is no marker.
_MARKER = re.compile(rb"\xff([^\x00\xff])")
# Segments hold up to 64 KiB, so these are more than any metadata need. Cameras write one segment of Exif, or a few.
_MAX_SEGMENTS, _MAX_EXIF_SEGMENTS = 2_000, 16
# Encoders of PNG write pixels in chunks of 8 KiB and more.
_MAX_CHUNKS = 20_000
_PNG = b"\x89PNG\r\n\x1a\n"
# Length before and checksum after each chunk.
_CHUNK_FRAME = 12
XMP, _XMP_EXTENSION = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
# GUID, total length and offset before each part of an extension.
_GUID_BYTES, _EXTENSION_HEAD = 32, 40
_PNG_XMP = b"XML:com.adobe.xmp\0"
# Photographs have one or two packets; extensions hold other pictures, such as depth, after the properties.
_MAX_PACKETS, _MAX_EXTENSION_BYTES = 16, 2**20
# Chunks of a PNG that describe it, and the bytes of all such chunks that are kept, as stored and inflated.
_TEXTS = (b"tEXt", b"zTXt", b"iTXt", b"iCCP")
MAX_TEXT_BYTES = 256 * 1024


def markers(content: bytes) -> Iterator[tuple[int, int]]:
    """Return every marker of a JPEG up to its end, as a decoder reads them, and the offset of its segment's length.

    Data after the end of the picture, such as the video of a motion photo, is ignored.
    """
    return takewhile(lambda found: found[0] != END_OF_IMAGE, _all_markers(content))


def _all_markers(content: bytes) -> Iterator[tuple[int, int]]:
    """Yield as `markers` does, the end of the picture and any markers after it included."""
    position = len(START)
    while (found := _MARKER.search(content, position)) is not None:
        marker, position = found[1][0], found.end()
        yield marker, position
        if marker not in _ALONE:
            position += int.from_bytes(content[position : position + 2], "big")


def count_scans(content: bytes, limit: int) -> tuple[int, bool]:
    """Count the scans of a JPEG, up to `limit` + 1, and tell whether its last bytes are missing.

    A scan of a few bytes makes the decoder visit every block of the picture again, so a small file can keep it busy for
    minutes.
    """
    count = 0
    for marker, _ in _all_markers(content):
        if marker == END_OF_IMAGE or count > limit:
            return count, False
        count += marker == START_OF_SCAN
    return count, True


def check_segments(content: bytes, max_scans: int) -> bool:
    """Refuse a JPEG or PNG with too many segments, scans or chunks; return whether a JPEG's last bytes are missing."""
    kind, counts, is_cut = "JPEG", list[tuple[int, int, str]](), False
    if content.startswith(START):
        head = takewhile(lambda found: found[0] != START_OF_SCAN, markers(content))
        segments = list(islice(head, _MAX_SEGMENTS + 1))
        exif = sum(marker == APP1 and content.startswith(b"Exif\0\0", place + 2) for marker, place in segments)
        counts = [(exif, _MAX_EXIF_SEGMENTS, "Exif segments, the limit")]
        counts += [(len(segments), _MAX_SEGMENTS, "segments, the limit")]
        scans, is_cut = count_scans(content, max_scans)
        counts += [(scans, max_scans, "scans, the limit (max_scans)")]
    elif content.startswith(_PNG):
        kind, chunks = "PNG", sum(1 for _ in islice(png_chunks(content), _MAX_CHUNKS + 1))
        counts = [(chunks, _MAX_CHUNKS, "chunks, the limit")]
    for count, limit, parts in counts:
        if count > limit:
            raise InvalidPhotographError(f"the photograph is a {kind} with more than {limit} {parts}; save it again")
    return is_cut


def png_chunks(content: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a PNG, and where its frame begins and ends."""
    position = len(_PNG)
    while position < len(content):
        end = position + _CHUNK_FRAME + int.from_bytes(content[position : position + 4], "big")
        yield content[position + 4 : position + 8], position, end
        position = end


def without_large_texts(content: bytes) -> tuple[bytes, int]:
    """Return a PNG without the texts and profiles that are too large, and the bytes that were left out.

    Other files are returned as they are. Compressed texts are inflated up to the limit only.
    """
    if not content.startswith(_PNG):
        return content, 0
    budget, position, kept = MAX_TEXT_BYTES, 0, []
    for kind, begin, end in png_chunks(content):
        if kind not in _TEXTS:
            continue
        text = content[begin + 8 : end - 4] if budget > end - begin else b""
        budget -= max(end - begin, len(_inflated(_compressed_part(kind, text), max(budget, 0))))
        if budget < 0:
            kept.append(content[position:begin])
            position = end
    kept.append(content[position:])
    light = b"".join(kept)
    return light, len(content) - len(light)


def _compressed_part(kind: bytes, text: bytes) -> bytes:
    """Return the compressed part of a chunk of text or of a profile, empty if there is none."""
    _, _, rest = text.partition(b"\0")
    if kind in (b"zTXt", b"iCCP"):
        return rest[1:]
    return _text_of(rest) if kind == b"iTXt" and rest[:1] == b"\1" else b""


def _text_of(rest: bytes) -> bytes:
    """Return the text of an iTXt chunk after its keyword: flag, method, language and translated keyword precede it."""
    return rest[2:].partition(b"\0")[2].partition(b"\0")[2]


def _inflated(data: bytes, limit: int) -> bytes:
    """Return the content of compressed data up to a limit and a byte, nothing if they are damaged."""
    try:
        return zlib.decompressobj().decompress(data, limit + 1)
    except zlib.error:
        return b""


def xmp_packets(content: bytes) -> tuple[list[bytes], int]:
    """Return the XMP packets of a JPEG or PNG, the first ones and an extension's begin, and the number left out."""
    if content.startswith(_PNG):
        texts = (content[begin + 8 : end - 4] for kind, begin, end in png_chunks(content) if kind == b"iTXt")
        found = [text.removeprefix(_PNG_XMP) for text in texts if text.startswith(_PNG_XMP)]
        packets = [
            _inflated(_text_of(rest), MAX_TEXT_BYTES) if rest[:1] == b"\1" else _text_of(rest)
            for rest in found[:_MAX_PACKETS]
        ]
    else:
        found = _jpeg_packets(content)
        packets = found[:_MAX_PACKETS]
    return packets, len(found) - len(packets)


def _jpeg_packets(content: bytes) -> list[bytes]:
    if not content.startswith(START):
        return []
    packets, extensions = [], []
    for marker, position in markers(content):
        if marker == START_OF_SCAN:
            break
        if marker != APP1:
            continue
        segment = content[position + 2 : position + int.from_bytes(content[position : position + 2], "big")]
        if segment.startswith(XMP):
            packets.append(segment[len(XMP) :])
        elif segment.startswith(_XMP_EXTENSION):
            part = segment[len(_XMP_EXTENSION) :]
            offset = int.from_bytes(part[_EXTENSION_HEAD - 4 : _EXTENSION_HEAD], "big")
            extensions.append((part[:_GUID_BYTES], offset, part[_EXTENSION_HEAD:]))
    joined = b"".join(part for _, offset, part in sorted(extensions) if offset < _MAX_EXTENSION_BYTES)
    return [*packets, joined] if joined else packets
