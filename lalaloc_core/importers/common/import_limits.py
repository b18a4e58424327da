"""Limits of an import, and the budget that enforces them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import DEFAULT_LIMITS, PlanLimits
from lalaloc_core.importers.common.import_report import Trace
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS, RoomBounds

_REMEDY = "export a single storey, or only the layers of walls, doors, windows and rooms"

# Copies of a file's shapes that any file may draw, beside those that its size allows.
_COPIES = 10_000
# Enough for the largest plan in the native format.
_MIN_JSON_VALUES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class ImportLimits:
    """Limits on a plan file; larger files are refused with the value and the limit.

    Attributes:
        max_unpacked_bytes: total size of the files in an archive, after decompression.
        max_entities: number of lines, polygons, texts and blocks, plus their vertices.
        max_depth: nesting depth of elements, blocks and objects.
        max_plan_pixels: pixels of a picture, or of a page that is rendered.
        max_levels: number of storeys with rooms.
        max_import_s: CPU time of an import. It is checked between entities, so a library call can exceed it.
        plan: limits of the plans in it.
        rooms: bounds by which rooms are recognised in drawings.
    """

    max_plan_bytes: int = 40 * 2**20
    max_unpacked_bytes: int = 200_000_000
    max_archive_files: int = 200
    max_entities: int = 300_000
    max_depth: int = 64
    max_plan_pixels: int = 40_000_000
    max_levels: int = 200
    max_import_s: float = 30.0
    plan: PlanLimits = DEFAULT_LIMITS
    rooms: RoomBounds = ROOM_BOUNDS

    @property
    def max_json_values(self) -> int:
        """Lists, objects and further items of a JSON text, for `read_json`."""
        return max(_MIN_JSON_VALUES, 10 * self.max_entities)


DEFAULT_IMPORT_LIMITS = ImportLimits()


@dataclass(frozen=True)
class ImportStep:
    """Step of an import that begins now.

    Attributes:
        step: what is done, such as "reading texts".
        done: number of levels that are done; None for a step that is not about one level of several.
        total: number of levels; None as `done`.
    """

    step: str
    done: int | None = None
    total: int | None = None

    def __str__(self) -> str:
        return self.step if self.total is None else f"{self.step} ({(self.done or 0) + 1} of {self.total})"


# Called with every step as it begins, and between steps, which raises an exception to stop.
OnStep, CheckTime = Callable[[ImportStep], None], Callable[[], None]


@dataclass
class Budget:
    """Counter of the entities and the time that an import has used.

    Attributes:
        trace: receives what is read from a drawing, if anyone asks for it.
        on_step: called with every step of the import as it begins.
        size_bytes: size of the file, which bounds the copies of its shapes; 0 if unknown.
        hints: what the message of an error says besides, such as the page that was read.
    """

    limits: ImportLimits = DEFAULT_IMPORT_LIMITS
    # A busy machine refuses no file.
    clock: Callable[[], float] = time.process_time
    trace: Trace | None = None
    on_step: OnStep | None = None
    size_bytes: int = 0
    entities: int = 0
    hints: list[str] = field(default_factory=list)
    started_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.started_s = self.clock()

    @property
    def elapsed_s(self) -> float:
        """CPU time since the start of the import."""
        return self.clock() - self.started_s

    def spend(self, entities: int = 1) -> None:
        """Count entities and check the time."""
        self.entities += entities
        if self.entities > self.limits.max_entities:
            raise InvalidFloorPlanError(
                f"the file has more than {self.limits.max_entities} entities (max_entities); {_REMEDY}"
            )
        self.check_time()

    def begin(self, step: str, done: int | None = None, total: int | None = None) -> None:
        """Tell that a step begins, see `ImportStep`, and check the time.

        Raises:
            InvalidFloorPlanError: the import takes longer than `max_import_s`.
        """
        self.check_time()
        if self.on_step is not None:
            self.on_step(ImportStep(step, done, total))

    def check_copies(self, shapes: int, bytes_each: int) -> None:
        """Check the number of shapes that are drawn after all copies are made, before they are.

        Blocks, symbols and packed operators can draw hundreds of thousands of shapes from a few hundred bytes, and the
        time to read a file follows from its shapes. Shapes that a file states take at least `bytes_each` of it.
        """
        limit = _COPIES + self.size_bytes // bytes_each
        if shapes > limit:
            raise InvalidFloorPlanError(
                f"the file of {self.size_bytes} bytes draws more than {limit} shapes, the limit for its size, with "
                "copies of its blocks or symbols or by repeated lines; remove the copies, or explode the blocks"
            )

    def check_time(self) -> None:
        """Check the time."""
        if self.elapsed_s > self.limits.max_import_s:
            raise InvalidFloorPlanError(
                f"reading the file takes more than {self.limits.max_import_s:g} s of CPU time (max_import_s); {_REMEDY}"
            )
