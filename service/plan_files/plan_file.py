"""Conversion of an uploaded plan file.

The service parses single native plans of up to 256 KiB itself, in milliseconds. Worker processes read, validate and
describe all others: large or many plans would take the interpreter from other requests, and other formats can crash
their reader.
"""

from __future__ import annotations

from dataclasses import dataclass

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.file_kinds import describe_file
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import (
    ImportOptions,
    Level,
    begins_with_plans,
    detect_format,
    detect_media_type,
    import_if_native,
    is_json,
)
from service.capacity.fair_share import FairSemaphore
from service.plan_files.convert_worker import Imported, report_of
from service.plan_files.converter import Converter
from service.settings import Settings
from service.stored_plan import LARGE, PlanDocument, Rendition
from service.uploaded_file import UploadedFile


@dataclass(frozen=True)
class PlanFile:
    """Plan of an uploaded file.

    Attributes:
        plan: plan, validated under the service's limits.
        level: level of the plan, if the file has levels.
        report: report of the import as JSON text.
        media_type: media type of the file, detected from its content.
        document: stored form of the plan; None if it is to be made.
        description: result of `describe_content`; None if it is to be made.
    """

    plan: FloorPlan
    report: str
    media_type: str
    level: Level | None = None
    document: PlanDocument | None = None
    description: Rendition | None = None


def seems_native(file: UploadedFile) -> bool:
    """Return whether a file looks like a small native plan, which needs no worker."""
    return len(file) <= LARGE and _seems_native(file.read())


def _seems_native(content: bytes) -> bool:
    is_small = len(content) <= LARGE and not begins_with_plans(content)
    return is_small and is_json(content) and describe_file(content) is None


def convert(
    content: bytes,
    options: ImportOptions,
    name: str | None,
    converter: Converter,
    settings: Settings,
    client: str,
    permits: FairSemaphore,
) -> PlanFile:
    """Convert an uploaded file to its only plan. Blocks.

    Args:
        content: the file.
        options: options of the import.
        name: name for a plan that has none.
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
    if (native := _convert_native(content, options, name, settings, client, permits)) is not None:
        return native
    (imported,) = converter.read(content, options, client, building=name)
    return _plan_file(imported, client, permits)


def convert_levels(
    content: bytes,
    options: ImportOptions,
    building: str,
    converter: Converter,
    settings: Settings,
    client: str,
    permits: FairSemaphore,
) -> list[PlanFile]:
    """Convert an uploaded file to the plans of its levels, lowest first. Blocks.

    Args:
        content: the file.
        options: options of the import.
        building: name for plans that have none, and for those of several levels, unless the options have one.
        converter: as for `convert`; so are the other arguments.
        settings: the settings.
        client: client of the upload.
        permits: permits to compute in this process.

    Raises:
        InvalidFloorPlanError: the file or a level is invalid, or exceeds a limit.
        MissingExtraError, OverloadedError, DeadlineExceededError, ConverterNotReadyError, StoppingError: see `convert`.
    """
    if (native := _convert_native(content, options, building, settings, client, permits)) is not None:
        return [native]
    levels = converter.read(content, options, client, every_level=True, building=building)
    return [_plan_file(imported, client, permits) for imported in levels]


def _convert_native(
    content: bytes,
    options: ImportOptions,
    name: str | None,
    settings: Settings,
    client: str,
    permits: FairSemaphore,
) -> PlanFile | None:
    """Convert a small native plan; None leaves other files, of formats that are supported, to the workers."""
    if not content.strip():
        raise InvalidFloorPlanError("the body is empty; send a plan file")
    limits = settings.plans.import_limits
    if _seems_native(content):
        with permits.hold(client):
            imported = import_if_native(content, options, limits, building=name)
            if imported is not None:
                return PlanFile(imported.plan(limits.plan), report_of(imported), detect_media_type(content, "native"))
    elif not is_json(content):
        # Reject unsupported formats before they take a worker.
        detect_format(content, limits)
    return None


def _plan_file(imported: Imported, client: str, permits: FairSemaphore) -> PlanFile:
    with permits.hold(client):
        plan = imported.plan.plan()
    return PlanFile(plan, imported.report, imported.media_type, imported.level, imported.document, imported.description)
