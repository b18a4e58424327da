"""GPano properties in the XMP packets of a picture file.

Packets are not trusted. One that is not well-formed XML, such as one whose prefix is not declared, is searched for the
properties as text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

_NAME = re.compile(r"\{https?://ns\.google\.com/photos/1\.0/panorama/?\}([A-Za-z]{1,40})")
# A packet of a JPEG fits into one segment of 64 KiB; larger ones, such as extensions, are searched as text.
_MAX_XML_BYTES = 256 * 1024
# Longest value that is read, and most warnings.
_MAX_VALUE, _MAX_WARNINGS = 50, 3
# An attribute with its value, or an element with its text.
_PROPERTY = re.compile(rb"GPano:([A-Za-z]{1,40})\s{0,9}(?:=\s{0,9}[\"']([^\"'<>]{0,200})[\"']|>([^<>]{0,200})<)")


def read_gpano(packets: Sequence[bytes | str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the GPano properties of all packets, and warnings; the first of each name counts."""
    found: dict[str, str] = {}
    warnings: list[str] = []
    for packet in packets:
        for name, value in _properties(packet):
            first = found.setdefault(name, value)
            if first != value:
                warnings.append(f"GPano {name} is stated as '{first}' and as '{value}'; the first is used")
    return found, tuple(dict.fromkeys(warnings))[:_MAX_WARNINGS]


def _properties(packet: bytes | str) -> Iterator[tuple[str, str]]:
    content = packet.encode(errors="replace") if isinstance(packet, str) else packet
    content = content.strip(b"\0 \r\n\t")
    if b"GPano:" not in content and len(content) > _MAX_XML_BYTES:
        return
    try:
        root = fromstring(content, forbid_dtd=True) if 0 < len(content) <= _MAX_XML_BYTES else None
    except DefusedXmlException:
        return
    except (ParseError, ValueError, LookupError):
        root = None
    if root is None:
        for match in _PROPERTY.finditer(content):
            value = match[2] if match[3] is None else match[3]
            yield match[1].decode(), _clean(value.decode(errors="replace"))
        return
    for element in root.iter():
        for name, value in [*element.attrib.items(), (element.tag, element.text or "")]:
            if (match := _NAME.fullmatch(name)) is not None:
                yield match[1], _clean(value)


def _clean(value: str) -> str:
    return "".join(character for character in value.strip()[:_MAX_VALUE] if character.isprintable())
