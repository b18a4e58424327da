"""Zip archives in memory, with limits: nothing is written to disk, nothing inside another archive is opened."""

from __future__ import annotations

import io
import zipfile
import zlib

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.model.limits import ImportLimits


def read_archive(content: bytes, limits: ImportLimits, *, endings: tuple[str, ...]) -> dict[str, bytes]:
    """The files of a zip archive whose names end in one of `endings`, by name.

    Raises:
        InvalidFloorPlanError: no zip archive, or one that is encrypted, damaged or unpacks to more than it may.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _read_members(archive, limits, endings)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, OSError) as error:
        raise InvalidFloorPlanError(f"the archive is damaged: {error}") from error


def _read_members(archive: zipfile.ZipFile, limits: ImportLimits, endings: tuple[str, ...]) -> dict[str, bytes]:
    members = archive.infolist()
    if len(members) > limits.max_archive_files:
        raise InvalidFloorPlanError(
            f"the archive has {len(members)} files, at most {limits.max_archive_files} are read (max_archive_files)"
        )
    found: dict[str, bytes] = {}
    left = limits.max_unpacked_bytes
    for member in members:
        if member.is_dir() or not member.filename.casefold().endswith(endings):
            continue
        if member.flag_bits & 0x1:
            raise InvalidFloorPlanError(f"'{member.filename[:100]}' is encrypted; send the archive without a password")
        # What the directory says of sizes may be a lie: no more is unpacked than may be, whatever it says.
        with archive.open(member) as stream:
            content = stream.read(left + 1)
        left -= len(content)
        if left < 0:
            raise InvalidFloorPlanError(
                f"the archive unpacks to more than {limits.max_unpacked_bytes} bytes (max_unpacked_bytes)"
            )
        found[member.filename] = content
    return found
