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
from service.plan_documents import LARGE, PlanDocument, Rendition
from service.plan_files.convert_worker import Imported, report_of
from service.plan_files.converter import Converter
from service.settings import Settings
from service.uploaded_file import UploadedFile


@dataclass(frozen=True)
class PlanFile:
    """Plan of an uploaded file."""

    plan: FloorPlan
    report: str
    media_type: str
    level: Level | None = None
    document: PlanDocument | None = None
    description: Rendition | None = None


def seems_native(file: UploadedFile) -> bool:
    """Return whether a file looks like a small native plan, which needs no worker."""
    if len(file) > LARGE:
        return False
    content = file.read()
    return is_json(content) and not begins_with_plans(content) and describe_file(content) is None


@dataclass(frozen=True)
class PlanReader:
    """Reader of an uploaded plan file; its calls block.

    Attributes:
        is_native: result of `seems_native`; a worker still reads JSON of other formats.
    """

    content: bytes
    options: ImportOptions
    is_native: bool
    client: str
    converter: Converter
    settings: Settings
    cores: FairSemaphore
    on_step: OnStep | None = None

    def read(self, name: str | None) -> PlanFile:
        """Return the only plan of the file; `name` is for a plan without."""
        (plan,) = self._read(name, every_level=False)
        return plan

    def read_levels(self, name: str) -> list[PlanFile]:
        """Return the plans of the levels of the file, lowest first; raises as `read` does.

        `name` is for plans that have none, and for those of several levels, unless the options have one.
        """
        return self._read(name, every_level=True)

    def _read(self, name: str | None, *, every_level: bool) -> list[PlanFile]:
        limits = self.settings.plans.import_limits
        if not self.content.strip():
            raise InvalidFloorPlanError("the body is empty; send a plan file")
        if self.is_native:
            with self.cores.hold(self.client):
                imported = import_if_native(self.content, self.options, limits, building=name)
                if imported is not None:
                    media_type = detect_media_type(self.content, "native")
                    return [PlanFile(imported.plan(limits.plan), report_of(imported), media_type)]
        elif not is_json(self.content):
            # Reject unsupported formats before they take a worker.
            detect_format(self.content, limits)
        levels = self.converter.read(
            self.content, self.options, self.client, every_level=every_level, building=name, on_step=self.on_step
        )
        return [self._plan_file(level) for level in levels]

    def _plan_file(self, imported: Imported) -> PlanFile:
        with self.cores.hold(self.client):
            plan = imported.plan.plan()
        return PlanFile(
            plan, imported.report, imported.media_type, imported.level, imported.document, imported.description
        )
