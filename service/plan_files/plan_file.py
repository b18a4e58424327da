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
    OnStep,
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


@dataclass(frozen=True)
class PlanReader:
    """Reader of uploaded plan files; its calls block.

    Attributes:
        converter: workers for files that are not in the native format.
        settings: the settings.
        permits: permits to compute in this process.
    """

    converter: Converter
    settings: Settings
    permits: FairSemaphore

    def read(
        self, content: bytes, options: ImportOptions, name: str | None, client: str, on_step: OnStep | None = None
    ) -> PlanFile:
        """Return the only plan of a client's file; `name` is for a plan without, `on_step` as for `Converter.read`.

        Raises:
            InvalidFloorPlanError: the file is invalid or exceeds a limit.
            SeveralLevelsError: the file has several storeys and no `level` is set.
            MissingExtraError: a library of its format is not installed.
            OverloadedError: the queue of the workers is full.
            DeadlineExceededError: the import did not finish in time.
            ConverterNotReadyError: no worker is running.
            StoppingError: the service is shutting down.
        """
        if (native := self._read_native(content, options, name, client)) is not None:
            return native
        (imported,) = self.converter.read(content, options, client, building=name, on_step=on_step)
        return self._plan_file(imported, client)

    def read_levels(
        self, content: bytes, options: ImportOptions, building: str, client: str, on_step: OnStep | None = None
    ) -> list[PlanFile]:
        """Return the plans of the levels of a client's file, lowest first.

        `building` is the name for plans that have none, and for those of several levels, unless the options have one.
        `on_step` is as for `Converter.read`.
        """
        if (native := self._read_native(content, options, building, client)) is not None:
            return [native]
        read = self.converter.read
        levels = read(content, options, client, every_level=True, building=building, on_step=on_step)
        return [self._plan_file(imported, client) for imported in levels]

    def _read_native(self, content: bytes, options: ImportOptions, name: str | None, client: str) -> PlanFile | None:
        """Read a small native plan; None leaves other files, of formats that are supported, to the workers."""
        if not content.strip():
            raise InvalidFloorPlanError("the body is empty; send a plan file")
        limits = self.settings.plans.import_limits
        if _seems_native(content):
            with self.permits.hold(client):
                imported = import_if_native(content, options, limits, building=name)
                if imported is not None:
                    return PlanFile(
                        imported.plan(limits.plan), report_of(imported), detect_media_type(content, "native")
                    )
        elif not is_json(content):
            # Reject unsupported formats before they take a worker.
            detect_format(content, limits)
        return None

    def _plan_file(self, imported: Imported, client: str) -> PlanFile:
        with self.permits.hold(client):
            plan = imported.plan.plan()
        return PlanFile(
            plan, imported.report, imported.media_type, imported.level, imported.document, imported.description
        )
