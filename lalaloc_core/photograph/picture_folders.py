"""Folders of photographs: their files, in order."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC
from pathlib import Path

from lalaloc_core.errors import InvalidInputError, InvalidPhotographError
from lalaloc_core.photograph.exif import read_taken
from lalaloc_core.photograph.picture_files import PhotographLimits, opened_picture

MAX_TURN_PHOTOGRAPHS = 100
# Larger files are not read for their time.
_MAX_BYTES = 200 * 2**20
# Suffixes of files in a folder that can be photographs.
PICTURES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".insp"})


def turn_files(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the photographs of a turn in a folder, and lines on their order and on empty, hidden and other files.

    They are in the order of their times, if all have different ones, else in that of the numbers in their names.
    """
    files = pictures_in(folder, require=False)
    used = [file for file in files if file.stat().st_size]
    times = {file: _taken_at(file) for file in used} if len(used) <= MAX_TURN_PHOTOGRAPHS else {}
    notes, untimed = [f"'{file.name}' is empty and was left out" for file in files if file not in used], len(used)
    untimed -= len({time for time in times.values() if time is not None})
    if not untimed:
        used.sort(key=lambda file: times[file] or 0.0)
    elif untimed < len(used):
        text = "have no time of their own, so all are in the order of the numbers in their names: check it"
        notes.append(f"{untimed} of {len(used)} photographs {text}")
    return used, notes + left_out(folder, files)


def left_out(folder: Path, used: Iterable[Path]) -> list[str]:
    """Return lines on what a folder has besides files that are used: hidden files, folders and other files."""
    known = {path.resolve() for path in used}
    others = sorted(entry for entry in folder.iterdir() if entry.resolve() not in known)
    shown = [entry for entry in others if not entry.name.startswith(".")]
    kinds = {
        "hidden files": [entry for entry in others if entry not in shown and entry.suffix.lower() in PICTURES],
        "folders": [entry for entry in shown if entry.is_dir()],
        "files that are no JPEG, PNG, WebP or HEIC pictures": [entry for entry in shown if not entry.is_dir()],
    }
    return [f"{kind}, such as '{of[0].name}', were left out: {len(of)}" for kind, of in kinds.items() if of]


def _taken_at(file: Path) -> float | None:
    """Return the time (s) of a photograph by its metadata; None without one."""
    try:
        if file.stat().st_size > _MAX_BYTES:
            return None
        with opened_picture(file.read_bytes(), PhotographLimits()) as picture:
            at = read_taken(picture.exif, picture.packets, width=0, height=0).at
    except (OSError, InvalidPhotographError):
        return None
    return None if at is None else at.replace(tzinfo=at.tzinfo or UTC).timestamp()


def pictures_in(folder: Path, *, require: bool = True) -> list[Path]:
    """Return the picture files in a folder, sorted by name; numbers in names count as such.

    Raises:
        InvalidInputError: the folder cannot be read, or has no pictures although they are required.
    """
    try:
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise InvalidInputError(f"'{folder}' cannot be read as a folder: {error.strerror}") from error
    entries.sort(key=lambda entry: with_numbers(entry.name))
    found = [entry for entry in entries if entry.suffix.lower() in PICTURES and entry.is_file()]
    if require and not found:
        raise InvalidInputError(f"'{folder}' has no photographs ({', '.join(sorted(PICTURES))})")
    return found


def with_numbers(name: str) -> list[str]:
    """Return a key by which "2.jpg" is before "10.jpg"."""
    return [part.zfill(20) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
