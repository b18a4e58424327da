"""Zip archives and XML, read within limits; archives are written without times, XML is read without entities."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from xml.etree.ElementTree import Element, ParseError

import defusedxml
from defusedxml import ElementTree as SafeElementTree

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits

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
    members = [
        member for member in archive.infolist() if not member.is_dir() and member.filename.casefold().endswith(suffixes)
    ]
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


def read_xml(content: bytes, budget: Budget) -> Element:
    """Parse XML without entities and external references, and return its root."""
    try:
        root = SafeElementTree.fromstring(content, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except defusedxml.EntitiesForbidden as error:
        raise InvalidFloorPlanError(
            "the XML declares entities, which are not supported; save the file without them (a drawing as plain SVG)"
        ) from error
    except defusedxml.DefusedXmlException as error:
        raise InvalidFloorPlanError(
            "the XML refers to other files, which are not read; save a drawing as plain SVG"
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
