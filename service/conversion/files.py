"""Conversion of an uploaded plan file.

The service parses small native plans itself, because JSON of bounded depth and size is harmless. Worker processes read
all other files, which can be slow or crash their reader.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.file_kinds import describe_file
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, detect_format, detect_media_type, import_if_native, is_json
from service.conversion.converter import Converter
from service.settings import Settings
from service.tenancy.fair_share import FairSemaphore
from service.uploaded_file import UploadedFile
from service.workers.convert import report_of

_MAX_IN_PROCESS_BYTES = 2 * 2**20


@dataclass(frozen=True)
class PlanFile:
    """Plan of an uploaded file.

    Attributes:
        plan: plan, validated under the service's limits.
        report: report of the import as JSON data.
        media_type: media type of the file, detected from its content.
    """

    plan: FloorPlan
    report: dict[str, Any]
    media_type: str


def seems_native(file: UploadedFile) -> bool:
    """Return whether a file looks like a small native plan, which needs no worker."""
    return len(file) <= _MAX_IN_PROCESS_BYTES and _seems_native(file.read())


def _seems_native(content: bytes) -> bool:
    return len(content) <= _MAX_IN_PROCESS_BYTES and is_json(content) and describe_file(content) is None


def convert(
    content: bytes,
    options: ImportOptions,
    converter: Converter,
    settings: Settings,
    client: str,
    permits: FairSemaphore,
) -> PlanFile:
    """Convert an uploaded file to a plan. Blocks.

    Args:
        content: the file.
        options: options of the import.
        converter: workers for files that are not in the native format.
        settings: the settings.
        client: client of the upload.
        permits: permits to compute in this process.

    Raises:
        InvalidFloorPlanError: the file is invalid or exceeds a limit.
        SeveralLevelsError: the file has several storeys and no `level` is set.
        MissingExtraError: a library of its format is not installed.
        OverloadedError: the queue of the workers is full.
        DeadlineExceededError: the import did not finish in time.
        ConverterNotReadyError: no worker is running.
        StoppingError: the service is shutting down.
    """
    if not content.strip():
        raise InvalidFloorPlanError("the body is empty; send a plan file")
    limits = settings.plans.import_limits
    if _seems_native(content):
        with permits.hold(client):
            imported = import_if_native(content, options, limits)
            if imported is not None:
                return PlanFile(imported.plan(limits.plan), report_of(imported), detect_media_type(content, "native"))
    elif not is_json(content):
        # Reject unsupported formats before they take a worker.
        detect_format(content, limits)
    result = converter.read(content, options, client)
    with permits.hold(client):
        return PlanFile(FloorPlan.from_dict(result.document, limits.plan), result.report, result.media_type)
