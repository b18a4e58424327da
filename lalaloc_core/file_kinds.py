"""Kinds of files that are neither a photograph nor a floor plan, detected from the content, for error messages."""

from __future__ import annotations

import re

_PLACEHOLDER = "a property list, such as the placeholder of a file that is still in a cloud"
_ZEROS = "a file of zeros, such as the placeholder of a file that is still in a cloud"
_PAGE = "an HTML page, such as the page of a link to a file"
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
    (b"\x00\x00\x00\x0cJXL \r\n\x87\n", "a JPEG XL picture"),
    (b"\xff\x0a", "a JPEG XL picture"),
    (b"\x00\x00\x00\x0cjP  \r\n\x87\n", "a JPEG 2000 picture"),
    (b"\xff\x4f\xff\x51", "a JPEG 2000 picture"),
    (b"8BPS", "a Photoshop document"),
    (b"bplist00", _PLACEHOLDER),
    (b"version https://git-lfs.github.com/spec/", "a Git LFS pointer"),
    (b"PXR-USDC", "a USD model"),
    (b"#usda", "a USD model"),
    (b"glTF", "a glTF model"),
    (b"\xff\xfe\xff\x0eS\x00k\x00e\x00t\x00c\x00h\x00U\x00p", "a SketchUp model"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an OLE file, such as a Revit model"),
)
HEIC = "a HEIC picture"
AVIF = "an AVIF picture"
# Bytes 8 to 12 of an ISO media file are its brand; unlisted brands are videos.
_BRANDS = {
    **dict.fromkeys((b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1"), HEIC),
    **dict.fromkeys((b"avif", b"avis"), AVIF),
    b"jxl ": "a JPEG XL picture",
    b"crx ": "a raw picture of a camera",
}
# Kinds that stand for a file that is elsewhere, and the remedy.
STAND_INS = {
    _PLACEHOLDER: "download the file itself",
    _ZEROS: "download the file itself",
    _PAGE: "download the file itself",
    "a Git LFS pointer": "run `git lfs pull`",
}
# Brands that name no codec; the type of the coded items does.
_ANY_CODEC = {b"mif1", b"msf1"}
_GEOJSON = re.compile(rb'"type"\s{0,20}:\s{0,20}"(FeatureCollection|Feature|GeometryCollection|MultiPolygon|Polygon)"')
_HTML = re.compile(rb"(<\?xml[^>]{0,200}>|<!--.{0,1000}?-->|\s){0,8}<(!doctype html|html|head|body)\b", re.I | re.S)
_PROPERTY_LIST = re.compile(rb"<!doctype plist|<plist\b", re.I)
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
        is_av1 = content[8:12] in _ANY_CODEC and b"av01" in content[:_HEAD_BYTES]
        return AVIF if is_av1 else _BRANDS.get(content[8:12], "a video")
    head = content[:_HEAD_BYTES]
    if _HTML.match(head.removeprefix(b"\xef\xbb\xbf")):
        return _PAGE
    if _PROPERTY_LIST.search(head):
        return _PLACEHOLDER
    if content and not head.strip(b"\0"):
        return _ZEROS
    if b"<svg" in head:
        return "an SVG drawing"
    if _CITY_GML.search(head):
        return "a CityGML model"
    return "GeoJSON" if _GEOJSON.search(head) else None
