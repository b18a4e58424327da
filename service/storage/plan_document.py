"""A validated floor plan as it is stored: its document, and what was found when it was validated.

A plan is validated when it is uploaded. Reading it back believes what was stored, as long as it has the digest that it
was stored with.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan


@dataclasses.dataclass(frozen=True)
class PlanDocument:
    """What the table of revisions has of a plan.

    Attributes:
        document: the plan in the native format.
        document_sha256: its digest; None in a database that an earlier version of the service wrote.
        warnings: what was odd about it, as a JSON list; None likewise.
    """

    document: str
    document_sha256: str | None
    warnings: str | None

    @classmethod
    def of(cls, plan: FloorPlan) -> PlanDocument:
        """How a plan is stored."""
        document = json.dumps(plan.to_dict())
        return cls(document, _digest_of(document), json.dumps(plan.warnings))

    def columns(self) -> dict[str, Any]:
        """Values by the names of their columns."""
        return dataclasses.asdict(self)

    def plan(self) -> FloorPlan | None:
        """The plan; None when the document is not what was stored."""
        if self.document_sha256 is not None and _digest_of(self.document) != self.document_sha256:
            return None
        try:
            return FloorPlan.from_stored(self.document, None if self.warnings is None else json.loads(self.warnings))
        except (InvalidFloorPlanError, ValueError, TypeError):
            return None


def _digest_of(document: str) -> str:
    return hashlib.sha256(document.encode("utf-8", "surrogatepass")).hexdigest()
