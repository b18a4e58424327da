"""Copies of photographs with their place in EXIF and XMP; the coded picture itself is copied byte by byte.

Pillow builds the EXIF. Segments of JPEG and chunks of PNG are put in front of the picture; other formats get an XMP
file beside them, which photo managers read as well.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Container, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, ParseError, SubElement

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring
from PIL import ExifTags, Image

from lalaloc_core.photograph.file_segments import APP1, START, START_OF_SCAN, XMP, markers, png_chunks
from lalaloc_core.photograph.picture_files import PhotographLimits, opened_picture
from lalaloc_core.shown_text import printable

_EXIF = b"Exif\0\0"
_PNG_XMP = b"XML:com.adobe.xmp\0\0\0\0\0"
_MAX_SEGMENT = 65_533
_APP0 = 0xE0
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_NAMES = {
    "x": "adobe:ns:meta/",
    "rdf": _RDF,
    "dc": "http://purl.org/dc/elements/1.1/",
    "lr": "http://ns.adobe.com/lightroom/1.0/",
    "exif": "http://ns.adobe.com/exif/1.0/",
    "Iptc4xmpCore": "http://iptc.org/std/Iptc4xmpCore/1.0/xmlns/",
}


@dataclass(frozen=True, kw_only=True)
class Place:
    """The place of a photograph, as files state it.

    Attributes:
        latitude, longitude: degrees (WGS 84); None where unknown.
        direction_deg: azimuth of the photograph's centre, clockwise from true north; None where unknown.
    """

    room: str
    level: str
    latitude: float | None = None
    longitude: float | None = None
    direction_deg: float | None = None


class PlacedHead(NamedTuple):
    """Beginning of a copy, before the bytes of the file from `rest` on; and the XMP file beside it, if it needs one."""

    head: bytes
    rest: int
    sidecar: bytes | None = None


def placed_copy(content: bytes, place: Place) -> tuple[bytes, bytes | None]:
    """Return a copy of a picture file with a place, and the XMP file beside it; None if the copy has the place."""
    found = placed_head(content, place, PhotographLimits())
    return found.head + content[found.rest :], found.sidecar


def placed_head(content: bytes, place: Place, limits: PhotographLimits) -> PlacedHead:
    """Return the beginning of a copy of a picture file with a place.

    Positions and directions that the file states are replaced, keywords are added to its own.
    """
    with opened_picture(content, limits) as file:
        kind, exif = file.kind, file.exif
        packet = next((packet for packet in file.packets if packet), None)
        xmp = _xmp(packet, place)
        stated = _exif(exif, place)
    if kind == "JPEG" and len(XMP) + len(xmp) <= _MAX_SEGMENT:
        return _in_jpeg(content, stated, xmp)
    if kind == "PNG":
        return _in_png(content, stated, xmp)
    return PlacedHead(b"", 0, xmp)


def sidecar_name(name: str, taken: Container[str]) -> str:
    """Return the name of the XMP file beside a copy; `taken` are names whose case is folded."""
    # The name that all photo managers know; that with both suffixes for the second file of the same name.
    known = str(PurePosixPath(name).with_suffix(".xmp"))
    return f"{name}.xmp" if known.casefold() in taken else known


def _exif(exif: Image.Exif, place: Place) -> bytes | None:
    """Return the EXIF with position and direction; None if the file's own is to be kept."""
    if place.direction_deg is None and place.latitude is None:
        return None
    gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
    names = ExifTags.GPS
    for tag in (names.GPSDestBearing, names.GPSDestBearingRef, names.GPSHPositioningError):
        gps.pop(tag, None)
    gps[names.GPSVersionID] = b"\2\3\0\0"
    if place.latitude is not None and place.longitude is not None:
        gps[names.GPSLatitudeRef], gps[names.GPSLatitude] = "NS"[place.latitude < 0.0], _dms(place.latitude)
        gps[names.GPSLongitudeRef], gps[names.GPSLongitude] = "EW"[place.longitude < 0.0], _dms(place.longitude)
    if place.direction_deg is not None:
        gps[names.GPSImgDirectionRef], gps[names.GPSImgDirection] = "T", round(place.direction_deg % 360.0, 2)
    exif[ExifTags.IFD.GPSInfo] = gps
    try:
        found = exif.tobytes()
    except (AttributeError, TypeError, ValueError, struct.error):
        # Damaged tags can often be read, but not be written again.
        return None
    # Larger ones do not fit into the segment of a JPEG.
    return found if len(found) <= _MAX_SEGMENT else None


def _dms(degrees: float) -> tuple[float, float, float]:
    """Return degrees, minutes and seconds."""
    whole = abs(degrees)
    minutes = 60.0 * (whole % 1.0)
    return float(math.floor(whole)), float(math.floor(minutes)), round(60.0 * (minutes % 1.0), 5)


def _xmp(packet: bytes | None, place: Place) -> bytes:
    """Return an XMP packet with a place: the given one, if it can be read, with more properties."""
    room, level = printable(place.room), printable(place.level)
    for prefix, name in _NAMES.items():
        ElementTree.register_namespace(prefix, name)
    root = _parsed(packet)
    rdf = root if root.tag == f"{{{_RDF}}}RDF" else root.find(f"{{{_RDF}}}RDF")
    if rdf is None:
        rdf = SubElement(root, f"{{{_RDF}}}RDF")
    description = rdf.find(f"{{{_RDF}}}Description")
    if description is None:
        description = SubElement(rdf, f"{{{_RDF}}}Description", {f"{{{_RDF}}}about": ""})
    _add_words(rdf, description, "dc", "subject", [room, level])
    _add_words(rdf, description, "lr", "hierarchicalSubject", [f"{level}|{room}"])
    values = {("Iptc4xmpCore", "Location"): room}
    if place.latitude is not None and place.longitude is not None:
        values["exif", "GPSLatitude"] = _minutes(place.latitude, "NS")
        values["exif", "GPSLongitude"] = _minutes(place.longitude, "EW")
    if place.direction_deg is not None:
        values["exif", "GPSImgDirectionRef"] = "T"
        values["exif", "GPSImgDirection"] = f"{round(100.0 * (place.direction_deg % 360.0))}/100"
    for (prefix, name), value in values.items():
        tag = f"{{{_NAMES[prefix]}}}{name}"
        for each in rdf.findall(f"{{{_RDF}}}Description"):
            each.attrib.pop(tag, None)
            for old in each.findall(tag):
                each.remove(old)
        SubElement(description, tag).text = value
    body = ElementTree.tostring(root, encoding="unicode")
    begin = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
    return f'{begin}{body}\n<?xpacket end="w"?>'.encode()


def _parsed(packet: bytes | None) -> Element:
    if packet is not None:
        try:
            return fromstring(packet.strip(b"\0 \r\n\t"), forbid_dtd=True)
        except (ParseError, DefusedXmlException, ValueError, LookupError):
            pass
    return Element(f"{{{_NAMES['x']}}}xmpmeta")


def _add_words(rdf: Element, description: Element, prefix: str, name: str, words: Sequence[str]) -> None:
    """Add words to a bag, which is made if there is none."""
    tag = f"{{{_NAMES[prefix]}}}{name}"
    bag = rdf.find(f"{{{_RDF}}}Description/{tag}/{{{_RDF}}}Bag")
    if bag is None:
        bag = SubElement(SubElement(description, tag), f"{{{_RDF}}}Bag")
    known = {item.text for item in bag}
    for word in dict.fromkeys(words):
        if word and word not in known:
            SubElement(bag, f"{{{_RDF}}}li").text = word


def _minutes(degrees: float, letters: str) -> str:
    """Return degrees as XMP writes them: whole degrees, minutes, and a letter."""
    whole = math.floor(abs(degrees))
    return f"{whole},{60.0 * (abs(degrees) - whole):.8f}{letters[degrees < 0.0]}"


def _in_jpeg(content: bytes, exif: bytes | None, xmp: bytes) -> PlacedHead:
    """Return the head of a JPEG with other metadata: the bytes from the first scan on are copied."""
    kept, first, position = list[bytes](), list[bytes](), len(START)
    for marker, at in markers(content):
        end = at + int.from_bytes(content[at : at + 2], "big")
        if marker == START_OF_SCAN:
            position = at - 2
            break
        body = content[at + 2 : end]
        replaced = body.startswith(XMP) or (exif is not None and body.startswith(_EXIF))
        if not (marker == APP1 and replaced):
            target = first if marker == _APP0 or (marker == APP1 and body.startswith(_EXIF)) else kept
            target.append(bytes([0xFF, marker]) + content[at:end])
        position = end
    new = [] if exif is None else [_segment(exif if exif.startswith(_EXIF) else _EXIF + exif)]
    return PlacedHead(b"".join([START, *first, *new, _segment(XMP + xmp), *kept]), position)


def _segment(body: bytes) -> bytes:
    return bytes([0xFF, APP1]) + (len(body) + 2).to_bytes(2, "big") + body


def _in_png(content: bytes, exif: bytes | None, xmp: bytes) -> PlacedHead:
    """Return the head of a PNG with other metadata: all other chunks are copied."""
    parts, copied = list[bytes](), 0
    for kind, begin, end in png_chunks(content):
        is_xmp = kind == b"iTXt" and content.startswith(_PNG_XMP[:18], begin + 8)
        if is_xmp or (kind == b"eXIf" and exif is not None):
            parts.append(content[copied:begin])
            copied = end
        elif kind == b"IHDR":
            parts.append(content[copied:end])
            copied = end
            parts += [] if exif is None else [_chunk(b"eXIf", exif.removeprefix(_EXIF))]
            parts.append(_chunk(b"iTXt", _PNG_XMP + xmp))
    return PlacedHead(b"".join(parts), copied)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")
