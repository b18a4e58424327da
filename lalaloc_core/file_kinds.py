"""What a file is that is neither a panorama nor a floor plan, told by its content, so that a refusal can say so."""

from __future__ import annotations

import re

# How a file begins, and what it then is.
_BEGINNINGS = (
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
    (b"GIF87a", "a GIF picture"),
    (b"GIF89a", "a GIF picture"),
    (b"%PDF-", "a PDF document"),
    (b"II*\x00", "a TIFF picture"),
    (b"MM\x00*", "a TIFF picture"),
    (b"BM", "a BMP picture"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"AC10", "a DWG drawing"),
    (b"ISO-10303-21;", "an IFC or STEP model"),
)
# The brand of an ISO media file, in its bytes 8 to 12; those of moving pictures are many.
_BRANDS = {
    **dict.fromkeys((b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1"), "a HEIC picture"),
    **dict.fromkeys((b"avif", b"avis"), "an AVIF picture"),
}
# The type of what GeoJSON's files consist of, near their beginning.
_GEOJSON = re.compile(rb'"type"\s{0,20}:\s{0,20}"(FeatureCollection|Feature|GeometryCollection|MultiPolygon|Polygon)"')
_HEAD_BYTES = 4096


def describe_file(content: bytes) -> str | None:
    """What a file is, with its article; None when that cannot be told."""
    for beginning, kind in _BEGINNINGS:
        if content.startswith(beginning):
            return kind
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return "a WebP picture"
    if content[4:8] == b"ftyp":
        return _BRANDS.get(content[8:12], "a video")
    head = content[:_HEAD_BYTES]
    if b"<svg" in head:
        return "an SVG drawing"
    return "GeoJSON" if _GEOJSON.search(head) else None
