"""Documents of plans between store, service and worker processes: stored plans before they are parsed, files from them.

Light, because worker processes import it.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, Self

from lalaloc_core.conditions import CONDITIONS, Condition
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ExportFormat

if TYPE_CHECKING:
    from lalaloc_core.bundle import Bundle

# Files made from a plan: description (a part of the answer to GET), walls, rooms as SVG without and with the areas that
# became no room, mesh, exports; which photographs are found, and the map of that for each kind of them.
RenditionKind = (
    Literal["description", "layout", "drawing", "preview", "mesh", "localisability", "coarse localisability"]
    | ExportFormat
    | Condition
)
# Files that depend on the model.
PREDICTIONS: frozenset[RenditionKind] = frozenset({"localisability", "coarse localisability", *CONDITIONS})
# Made by worker processes even of small plans: the cells of maps are many, and predictions search the plan.
SLOW: frozenset[RenditionKind] = frozenset({"ros", *PREDICTIONS})
# Characters or bytes of a document beyond which worker processes parse it.
LARGE = 256 * 1024
# Rooms, openings or faces per piece of a packed plan: less than a millisecond of the interpreter.
_PIECE = 50
# Fields of a plan that can have thousands of items.
_LONG = ("rooms", "openings", "opening_faces")


@dataclass(frozen=True)
class PlanDocument:
    """Stored form of a plan, which was validated at upload; reading it back checks only its digest.

    Attributes:
        document: the plan in the native format.
        document_sha256: its digest; None for plans stored by an earlier version of the service.
        warnings: warnings of the validation as a JSON list; None as for the digest.
    """

    document: str
    document_sha256: str | None
    warnings: str | None

    @classmethod
    def from_plan(cls, plan: FloorPlan) -> PlanDocument:
        """Return the stored form of a plan."""
        document = json.dumps(plan.to_dict())
        return cls(document, _digest(document), json.dumps(plan.warnings))

    def plan(self) -> FloorPlan | None:
        """Return the plan; None if the document is damaged."""
        if self.document_sha256 is not None and _digest(self.document) != self.document_sha256:
            return None
        try:
            return FloorPlan.from_stored(self.document, None if self.warnings is None else json.loads(self.warnings))
        except (InvalidFloorPlanError, ValueError, TypeError):
            return None


@dataclass(frozen=True)
class PackedPlan:
    """Validated plan on its way from a worker process.

    It is pickled in pieces: unpickling holds the interpreter, so other threads run between the pieces only.

    Attributes:
        fields: pickled fields and cached values of the plan, except the long fields.
        pieces: for each of the long fields, its items in pickled lists.
    """

    fields: bytes
    pieces: tuple[tuple[bytes, ...], ...]

    @classmethod
    def of(cls, plan: FloorPlan) -> Self:
        """Return a packed plan, with the values that the service always needs."""
        _ = plan.wall_table, plan.areas_m2
        fields = {name: value for name, value in vars(plan).items() if name not in _LONG}
        return cls(pickle.dumps(fields), tuple(_pieces(getattr(plan, name)) for name in _LONG))

    def plan(self) -> FloorPlan:
        """Return the plan, which is not validated again."""
        plan = object.__new__(FloorPlan)
        vars(plan).update(pickle.loads(self.fields))
        for name, pieces in zip(_LONG, self.pieces, strict=True):
            vars(plan)[name] = tuple(item for piece in pieces for item in pickle.loads(piece))
        return plan


def _pieces(items: Sequence[Any]) -> tuple[bytes, ...]:
    return tuple(pickle.dumps(items[first : first + _PIECE]) for first in range(0, len(items), _PIECE))


@dataclass(frozen=True, kw_only=True)
class PlanHead:
    """Stored plan at one of its revisions, without its rooms.

    Attributes:
        revision_id: id of the revision, unique among all plans.
        revision: number of the revision, from 1.
        created_at: time when the plan was first stored.
        updated_at: time when the revision was stored.
        report: import report as JSON text; None for plans of an earlier version of the service.
    """

    id: str
    revision_id: str
    revision: int
    created_at: datetime
    updated_at: datetime
    report: str | None = None


@dataclass(frozen=True, kw_only=True)
class StoredPlan(PlanHead):
    """Stored plan as the database holds it, with its document."""

    document: PlanDocument


@dataclass(frozen=True)
class RenditionJob:
    """Stored plan from which a file is made.

    Attributes:
        step_m: grid step, for the estimated size of the pose grid.
        bundle: model of the service, for localisability.
        report: the localisability, for its maps.
    """

    stored: StoredPlan
    kind: RenditionKind
    step_m: float
    bundle: Bundle | None = None
    report: bytes = b""


@dataclass(frozen=True)
class Rendition:
    """File made from a revision of a plan.

    Attributes:
        poses: estimated size of the pose grid; 0 in files other than descriptions.
    """

    content: bytes
    bounds_m: tuple[float, float, float, float]
    poses: int = 0


def _digest(document: str) -> str:
    return hashlib.sha256(document.encode("utf-8", "surrogatepass")).hexdigest()
