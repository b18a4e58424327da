"""Queries as they are after the upload; each names the type of its answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from lalaloc_core.draw.answer import Picture
from lalaloc_core.photograph import Photograph
from service.query_context import QueryContext
from service.schemas import (
    LocaliseAnswer,
    LocaliseForm,
    PhotographForm,
    SequenceAnswer,
    SequenceForm,
    SessionDocument,
    StoredPose,
)
from service.schemas.albums import AlbumDocument
from service.storage.album_jobs import AlbumPart
from service.storage.records import PlanRecord, VenueRecord
from service.uploaded_file import UploadedFile

# Timeout (s) of the solve of an album, after its plans are loaded.
SOLVE_S = 900.0
# Photograph of a query: a file, or a photograph that was encoded on its device (`localise.encode.features`).
Content = bytes | UploadedFile | Photograph
# Plans that a query searches.
Where = PlanRecord | VenueRecord
AnswerT = TypeVar("AnswerT", covariant=True)


class AnyQuery(Generic[AnswerT]):
    """Query about a plan or venue, with the type of its answer."""

    context: QueryContext


@dataclass(frozen=True, eq=False)
class PhotographQuery(AnyQuery[LocaliseAnswer]):
    """Query about one photograph.

    Attributes:
        content: the uploaded picture file, or what was read of its features.
    """

    form: LocaliseForm
    content: Content
    context: QueryContext


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureQuery(AnyQuery[tuple[LocaliseAnswer, bytes]]):
    """Query about one photograph in a plan, whose answer is also drawn, as a PNG or SVG file."""

    form: LocaliseForm
    content: Content
    context: QueryContext
    picture: Picture
    as_png: bool
    rooms: str


@dataclass(frozen=True, eq=False)
class SequenceQuery(AnyQuery[SequenceAnswer]):
    """Query about several photographs of one visit.

    Attributes:
        contents: the uploaded picture files, or what was read of their features, in the order in which they were taken;
            none if there is a film.
    """

    form: SequenceForm
    contents: Sequence[Content]
    context: QueryContext
    film: bytes | UploadedFile | None = None


@dataclass(frozen=True)
class TrackOutcome:
    """State of a session after a photograph, and the stored part of its answer."""

    state: bytes
    stored: StoredPose


@dataclass(frozen=True, eq=False)
class TrackQuery(AnyQuery[TrackOutcome]):
    """Photograph of a session.

    Attributes:
        state: state after the photographs before; None for the first.
    """

    session_id: str
    document: SessionDocument
    state: bytes | None
    form: PhotographForm
    content: Content
    context: QueryContext


@dataclass(frozen=True)
class AlbumEntry:
    """Parts of a photograph that an album keeps: its features, and size, time and camera as JSON."""

    entry: bytes
    facts: str


@dataclass(frozen=True, eq=False, kw_only=True)
class AlbumPhotographQuery(AnyQuery[AlbumEntry]):
    """Photograph that is added to an album."""

    document: AlbumDocument
    content: Content
    sha256: str
    context: QueryContext


@dataclass(eq=False)
class AlbumProgress:
    """Progress of a solve, 0 to 1, which the caller can stop; between processes it is not shared.

    `found` has the evidence of photographs that were compared since the caller took it out, by id.
    """

    share: float = 0.0
    found: dict[str, bytes] = field(default_factory=dict)
    stopped: bool = False


@dataclass(frozen=True, kw_only=True)
class AlbumOutcome:
    """Solution of an album: the common part and the pin of each photograph, by id, as JSON."""

    solution: str
    pins: Mapping[str, str]


@dataclass(frozen=True, eq=False, kw_only=True)
class AlbumQuery(AnyQuery[AlbumOutcome]):
    """Album that is solved.

    Attributes:
        is_same_place: the earlier pins are of this revision of the plan or venue.
    """

    album_id: str
    document: AlbumDocument
    photographs: Sequence[AlbumPart]
    is_same_place: bool
    context: QueryContext
    progress: AlbumProgress
