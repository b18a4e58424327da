"""Films, and folders of photographs, of one turn on the spot, for `lalaloc localise --turn`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import Manifest
from lalaloc_core.cli.cameras import content_of, named, view_document
from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.errors import InvalidFilmError, InvalidInputError
from lalaloc_core.localise.belief import photograph_heading
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation
from lalaloc_core.localise.sequence.turn_localisation import LinkedTurn
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film, read_film
from lalaloc_core.photograph.turned import open_turn

_PICTURES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif"})
_MAX_PHOTOGRAPHS = 100


@dataclass(frozen=True, eq=False)
class Turn:
    """A turn that was read.

    Attributes:
        photographs: its photographs, or the frames that were kept.
        names: their names, or times.
        linked: their angles.
        film: the film; None for photographs.
        warnings: faults of the turn.
    """

    photographs: Sequence[Photograph]
    names: Sequence[str | float]
    linked: LinkedTurn
    film: Film | None
    warnings: list[str]


def read_turn(path: Path, manifest: Manifest, stated: StatedCamera) -> Turn:
    """Read a film, or the photographs of a folder in the order of their names."""
    if not path.is_dir():
        try:
            film = read_film(content_of(path), stated=stated, patch_size=patch_size(manifest))
        except InvalidFilmError as error:
            raise InvalidFilmError(f"'{path}': {error}") from error
        linked = LinkedTurn.of(film.angles)
        return Turn(film.photographs, film.times_s, linked, film, [*film.warnings, *_common_warnings(film.photographs)])
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in _PICTURES)
    if not 2 <= len(files) <= _MAX_PHOTOGRAPHS:
        raise InvalidInputError(f"'{path}' has {len(files)} photographs; a turn has 2 to {_MAX_PHOTOGRAPHS}")
    with named(path):
        photographs, angles = open_turn(
            [content_of(file) for file in files],
            stated,
            sphere_size=sphere_size(manifest),
            patch_size=patch_size(manifest),
        )
    linked = LinkedTurn.of(angles)
    warnings = linked.warnings(min(photograph.hfov.value for photograph in photographs))
    return Turn(photographs, [file.name for file in files], linked, None, [*warnings, *_common_warnings(photographs)])


def _common_warnings(photographs: Sequence[Photograph]) -> list[str]:
    """Return each warning about the photographs once."""
    return list(dict.fromkeys(warning for photograph in photographs for warning in photograph.warnings))


def turn_document(turn: Turn, found: SequenceLocalisation) -> dict[str, Any]:
    """Return the photographs of a turn, and the reading of its film, with the field names of the API."""
    poses = []
    for index, (photograph, picture) in enumerate(zip(turn.photographs, found.pictures, strict=True)):
        angles = turn.linked.angles[index]
        relative = {
            "value_deg": math.degrees(angles.heading),
            "std_deg": math.degrees(angles.heading_sd),
            "source": "assumed" if angles.is_assumed else "estimated",
        }
        poses.append(
            {
                ("photograph" if turn.film is None else "time_s"): turn.names[index],
                "heading_deg": heading_to_degrees(photograph_heading(picture.query, picture.candidates[0])),
                "view": view_document(photograph) | {"relative_heading": None if angles.group else relative},
            }
        )
    if turn.film is None:
        return {"poses": poses}
    film = turn.film
    reading = {
        "frames_read": film.frames,
        "frames_kept": len(film.photographs),
        "dropped": [{"reason": reason, "frames": frames} for reason, frames in film.dropped.items()],
        "duration_s": film.duration_s,
        "turned_deg": math.degrees(film.turned),
        "warnings": list(film.warnings),
    }
    return {"poses": poses, "film": reading}
