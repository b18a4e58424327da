"""What the file of a plan may cost, and the budget that an import spends from."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_LIMITS, PlanLimits


@dataclass(frozen=True, kw_only=True)
class ImportLimits:
    """Anything beyond is refused with the value and the limit.

    Attributes:
        max_plan_bytes: of the file.
        max_unpacked_bytes: of what an archive, or a compressed stream in a PDF or picture, unpacks to.
        max_archive_files: files in an archive.
        max_entities: lines, polygons, texts, blocks and the like, and vertices of all of them.
        max_depth: how deep elements, blocks and objects may lie within each other.
        max_plan_pixels: of a picture, or of a page that is drawn as one.
        max_import_s: of an import; looked at between entities, so a library's own call may end a little later.
        plan: of the plan that becomes of it.
    """

    max_plan_bytes: int = 50_000_000
    max_unpacked_bytes: int = 200_000_000
    max_archive_files: int = 200
    max_entities: int = 300_000
    max_depth: int = 64
    max_plan_pixels: int = 40_000_000
    max_import_s: float = 30.0
    plan: PlanLimits = DEFAULT_LIMITS


DEFAULT_IMPORT_LIMITS = ImportLimits()


@dataclass
class Budget:
    """Counts what an import has spent."""

    limits: ImportLimits = DEFAULT_IMPORT_LIMITS
    clock: Callable[[], float] = time.monotonic
    entities: int = 0
    started_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.started_s = self.clock()

    def spend(self, entities: int = 1) -> None:
        """Count entities, and look at the clock.

        Raises:
            InvalidFloorPlanError: more than the limits allow.
        """
        self.entities += entities
        if self.entities > self.limits.max_entities:
            raise InvalidFloorPlanError(
                f"the file has more than {self.limits.max_entities} entities (max_entities); "
                "export the layers that matter, or one storey, by itself"
            )
        self.check_time()

    def check_time(self) -> None:
        """Refuse to go on once the time is over.

        Raises:
            InvalidFloorPlanError: the import takes longer than it may.
        """
        elapsed_s = self.clock() - self.started_s
        if elapsed_s > self.limits.max_import_s:
            raise InvalidFloorPlanError(
                f"reading the file takes more than {self.limits.max_import_s:g} s (max_import_s); "
                "export the layers that matter, or one storey, by itself"
            )
