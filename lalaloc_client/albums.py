"""Albums: photographs that are pinned together to a plan or venue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from lalaloc_client.answers import GeoPose
from lalaloc_client.errors import problem_from
from lalaloc_client.model import Position

AlbumFormat = Literal["geojson", "csv", "svg"]
FORMAT_MEDIA: Mapping[AlbumFormat, str] = {"geojson": "application/geo+json", "csv": "text/csv", "svg": "image/svg+xml"}


@dataclass(frozen=True)
class PinPlace:
    """Place and direction of a photograph.

    Attributes:
        heading_deg: azimuth of the photograph's centre, clockwise from the plan's +y; None where it is unknown.
        probability: that of a suggestion; None for the place of a pin.
    """

    floorplan_id: str
    floorplan_revision: str
    room: str
    room_id: str
    position: Position
    level: float | None = None
    heading_deg: float | None = None
    probability: float | None = None


@dataclass(frozen=True)
class MovedPin:
    """Change of a pin by a new revision of its plan.

    Attributes:
        before: the pin before; None where it was set aside.
        distance_m: distance to it; None between plans.
    """

    before: PinPlace | None
    distance_m: float | None
    new_room: bool


@dataclass(frozen=True)
class Pin:
    """Pin of a photograph.

    Attributes:
        state: `sure`, `uncertain`, `set_aside` or `corrected`.
        confidence: probability that the room is right; services call it `room_confidence` as well.
        within_1m: probability that the position is right within 1 m.
        suggestions: up to five places, the most probable first.
        moved: change by the latest revision of the plan; None without one.
    """

    state: str
    place: PinPlace | None
    confidence: float
    within_1m: float
    reason: str
    suggestions: tuple[PinPlace, ...]
    warnings: tuple[str, ...]
    geopose: GeoPose | None = None
    moved: MovedPin | None = None


@dataclass(frozen=True)
class AlbumPhotograph:
    """Photograph of an album.

    Attributes:
        view: size, time and camera, and what was assumed about the picture.
        etag: entity tag, for `if_match`; None in lists.
    """

    id: str
    number: int
    revision: str
    name: str | None
    sha256: str
    added_at: datetime
    view: Mapping[str, Any]
    correction: Mapping[str, Any] | None
    pin: Pin | None
    etag: str | None = None


@dataclass(frozen=True)
class AddedPhotograph:
    """Answer to one photograph that was sent to an album.

    Attributes:
        status: 201 for a new photograph, 200 for one that the album had already, else that of the problem.
        retry_after_s: seconds after which it can be sent again; None if that does not help.
    """

    index: int
    status: int
    name: str | None = None
    photograph: AlbumPhotograph | None = None
    problem: Mapping[str, Any] | None = None
    retry_after_s: int | None = None

    def result(self) -> AlbumPhotograph:
        """Return the photograph.

        Raises:
            ProblemError: it could not be added.
        """
        if self.photograph is None:
            raise problem_from(self.problem or {}, self.status)
        return self.photograph


@dataclass(frozen=True)
class Album:
    """Stored album.

    Attributes:
        revision: id that changes with the photographs and their corrections.
        state: `empty`, `solving`, `solved`, `failed` or `outdated`.
        solved_revision_number: revision that the pins are of; 0 before the first solution.
        place_revision: revision of the plan or venue that the pins are of; None before, and in lists.
        solution: counts of pins, cameras, scale and warnings; None before the first solution, and in lists.
        etag: entity tag, for `if_match`; None in lists.
    """

    id: str
    revision: str
    revision_number: int
    name: str
    floorplan_id: str | None
    venue_id: str | None
    state: str
    progress: float
    reason: str | None
    photographs: int
    solved_revision_number: int
    created_at: datetime
    updated_at: datetime
    expires_at: datetime
    place_revision: str | None = None
    solution: Mapping[str, Any] | None = None
    etag: str | None = None
