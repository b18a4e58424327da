"""Zip archives and XML, read within limits; archives are written without times, XML is read without entities."""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from xml.etree.ElementTree import Element, ParseError

import defusedxml
from defusedxml import ElementTree as SafeElementTree

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits

# Declarations before the root, within so many bytes, and an entity of plain text; bytes that entities may add, and most
# entities.
_HEAD, _MAX_GROWN, _MAX_ENTITIES = 2**16, 2**20, 100
_SUBSET = re.compile(rb"<!DOCTYPE[^\[>]*\[(.*?)\]\s*>", re.DOTALL)
_ENTITY = re.compile(rb"""<!ENTITY\s+([\w.-]+)\s+(?:"([^"&%<]{0,1000})"|'([^'&%<]{0,1000})')\s*>""")
_REFERENCE = re.compile(rb"&([\w.-]{1,100});")
# Archives carry no time, so that equal plans give equal bytes.
_EPOCH = (2000, 1, 1, 0, 0, 0)
# Errors of the library for damaged archives; a name in an archive can be no text.
_DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, struct.error, RuntimeError)


def read_archive(content: bytes, limits: ImportLimits, *, suffixes: tuple[str, ...]) -> dict[str, bytes]:
    """Unpack the files with these suffixes (lower case) from a zip archive, in memory, without archives inside it.

    Returns:
        The files by name.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _read_members(archive, limits, suffixes)
    except InvalidFloorPlanError:
        raise
    except NotImplementedError as error:
        raise InvalidFloorPlanError(
            "the archive is packed by a method that is not supported; pack it again, with deflate"
        ) from error
    except _DAMAGES as error:
        raise InvalidFloorPlanError("the archive is damaged; pack or download it again") from error


def member_names(content: bytes, most: int) -> list[str]:
    """Return the names of the first members of a zip archive; none if it is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return archive.namelist()[:most]
    except (zipfile.BadZipFile, NotImplementedError, EOFError, OSError):
        return []


def pack(files: Mapping[str, bytes]) -> bytes:
    """Return a zip archive of files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _read_members(archive: zipfile.ZipFile, limits: ImportLimits, suffixes: tuple[str, ...]) -> dict[str, bytes]:
    members = [item for item in archive.infolist() if not item.is_dir() and item.filename.casefold().endswith(suffixes)]
    if len(members) > limits.max_archive_files:
        raise InvalidFloorPlanError(
            f"the archive has {len(members)} files ({', '.join(suffixes)}); the limit is {limits.max_archive_files} "
            "(max_archive_files); pack only the files of the plan"
        )
    found: dict[str, bytes] = {}
    remaining = limits.max_unpacked_bytes
    for member in members:
        if member.flag_bits & 0x1:
            raise InvalidFloorPlanError(f"'{member.filename[:100]}' is encrypted; send the archive without a password")
        # The sizes in the archive's directory can be forged, so the read itself is bounded.
        with archive.open(member) as stream:
            content = stream.read(remaining + 1)
        remaining -= len(content)
        if remaining < 0:
            raise InvalidFloorPlanError(
                f"the archive unpacks to more than {limits.max_unpacked_bytes} bytes (max_unpacked_bytes); "
                "pack only the files of the plan"
            )
        found[member.filename] = content
    return found


def local_name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _with_entities(content: bytes) -> bytes:
    """Return XML with the entities that it declares in place of their names, unless they are long or refer to others.

    Drawing programs write names of name spaces so.
    """
    subset = _SUBSET.search(content[:_HEAD])
    if subset is None:
        return content
    values = {name: first or second for name, first, second in _ENTITY.findall(subset[1])}
    if not 0 < len(values) <= _MAX_ENTITIES or b"<!ENTITY" in _ENTITY.sub(b"", subset[1]):
        return content
    quoted = {name: value.replace(b'"', b"&quot;").replace(b"'", b"&apos;") for name, value in values.items()}
    rest = content[subset.end() :]
    if sum(len(quoted.get(found[1], b"")) for found in _REFERENCE.finditer(rest)) > _MAX_GROWN:
        return content
    body = _REFERENCE.sub(lambda found: quoted.get(found[1], found[0]), rest)
    return content[: subset.start(1)] + _ENTITY.sub(b"", subset[1]) + content[subset.end(1) : subset.end()] + body


def read_xml(content: bytes, budget: Budget) -> Element:
    """Parse XML without external references, with short entities that refer to nothing, and return its root."""
    try:
        root = SafeElementTree.fromstring(
            _with_entities(content), forbid_dtd=False, forbid_entities=True, forbid_external=True
        )
    except defusedxml.EntitiesForbidden as error:
        raise InvalidFloorPlanError(
            "the XML declares entities that are long or refer to others, which are not supported; save it without them "
            "(Illustrator: presentation attributes, without editing capabilities; Inkscape: plain SVG)"
        ) from error
    except defusedxml.DefusedXmlException as error:
        raise InvalidFloorPlanError(
            "the XML refers to other files, which are not read; save it as plain SVG"
        ) from error
    except ParseError as error:
        line, column = error.position
        raise InvalidFloorPlanError(
            f"the XML is not well-formed in line {line}, column {column + 1}; save the file again"
        ) from error
    except (ValueError, LookupError) as error:
        raise InvalidFloorPlanError("the XML has an unknown encoding; save the file as UTF-8") from error
    pending = [(root, 1)]
    while pending:
        element, depth = pending.pop()
        if depth > budget.limits.max_depth:
            raise InvalidFloorPlanError(
                f"elements are nested more than {budget.limits.max_depth} deep (max_depth); ungroup a drawing"
            )
        budget.spend()
        pending.extend((child, depth + 1) for child in element)
    return root
