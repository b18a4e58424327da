"""What an uploaded file of a plan is: the native format is read here, all others in worker processes.

Small plans in the native format are JSON of bounded depth and size, which nothing can happen over; everything else,
large JSON included, would hold up everybody else, or may end the process that reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.file_kinds import describe_file
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, detect_format, import_if_native, is_json, media_type_of
from service.conversion.converter import Converter
from service.settings import Settings
from service.workers.convert import report_of

_MAX_IN_PROCESS_BYTES = 2 * 2**20


@dataclass(frozen=True)
class PlanFile:
    """An uploaded file, and what was understood of it.

    Attributes:
        plan: validated under the service's limits.
        report: of the import, as JSON has it.
        media_type: of the file, by its content.
    """

    plan: FloorPlan
    report: dict[str, Any]
    media_type: str


def seems_native(content: bytes) -> bool:
    """Whether a file is read here, as far as a glance can tell."""
    return len(content) <= _MAX_IN_PROCESS_BYTES and is_json(content) and describe_file(content) is None


def understand(
    content: bytes, options: ImportOptions, converter: Converter, settings: Settings, client: str
) -> PlanFile:
    """Read the file of a plan; blocks.

    Raises:
        InvalidFloorPlanError, SeveralLevelsError: what is wrong with it, and what to do.
        MissingExtraError, OverloadedError, DeadlineExceededError, ConverterNotReadyError, StoppingError: see
            `Converter.read`.
    """
    if not content.strip():
        raise InvalidFloorPlanError("the body is empty, the file of a floor plan is needed")
    limits = settings.plans.import_limits
    if seems_native(content):
        imported = import_if_native(content, options, limits)
        if imported is not None:
            return PlanFile(imported.plan(limits.plan), report_of(imported), media_type_of(content, "native"))
    elif not is_json(content):
        # Known at a glance, and refused at once where it is nothing known.
        detect_format(content, limits)
    read = converter.read(content, options, client)
    return PlanFile(FloorPlan.from_dict(read.document, limits.plan), read.report, read.media_type)
