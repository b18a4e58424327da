"""Kinds of files that are neither a photograph nor a floor plan, detected from the content, for error messages."""

from __future__ import annotations

import re

# First bytes of a file, and its kind.
_MAGIC = (
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
    (b"GIF8", "a GIF picture"),
    (b"%PDF-", "a PDF document"),
    (b"II*\x00", "a TIFF picture"),
    (b"MM\x00*", "a TIFF picture"),
    (b"BM", "a BMP picture"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"Rar!", "a RAR archive"),
    (b"7z\xbc\xaf", "a 7z archive"),
    (b"{\\rtf", "an RTF document"),
    (b"AC10", "a DWG drawing"),
    (b"ISO-10303-21;", "an IFC or STEP model"),
    (b"PXR-USDC", "a USD model"),
    (b"#usda", "a USD model"),
    (b"glTF", "a glTF model"),
    (b"\xff\xfe\xff\x0eS\x00k\x00e\x00t\x00c\x00h\x00U\x00p", "a SketchUp model"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an OLE file, such as a Revit model"),
)
HEIC = "a HEIC picture"
# Bytes 8 to 12 of an ISO media file are its brand; unlisted brands are videos.
_BRANDS = {
    **dict.fromkeys((b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1"), HEIC),
    **dict.fromkeys((b"avif", b"avis"), "an AVIF picture"),
}
_GEOJSON = re.compile(rb'"type"\s{0,20}:\s{0,20}"(FeatureCollection|Feature|GeometryCollection|MultiPolygon|Polygon)"')
_CITY_GML = re.compile(rb"<(?:[A-Za-z]+:)?CityModel[\s>]")
_HEAD_BYTES = 4096


def describe_file(content: bytes) -> str | None:
    """Return the kind of a file with its article, None if it is unknown."""
    for magic, kind in _MAGIC:
        if content.startswith(magic):
            return kind
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return "a WebP picture"
    if content[4:8] == b"ftyp":
        return _BRANDS.get(content[8:12], "a video")
    head = content[:_HEAD_BYTES]
    if b"<svg" in head:
        return "an SVG drawing"
    if _CITY_GML.search(head):
        return "a CityGML model"
    return "GeoJSON" if _GEOJSON.search(head) else None
