"""Program of a conversion worker process, the only part of the service that reads drawings and models.

It turns an `ImportJob` into plans, a `RenditionJob` into a `Rendition`, and a `ParseJob` into a `PackedPlan`. The
libraries of a format are loaded with its first file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import (
    ImportedPlan,
    ImportLimits,
    ImportOptions,
    Level,
    OnStep,
    detect_media_type,
    import_plan,
    import_plans,
)
from service.errors import DamagedDataError
from service.plan_documents import LARGE, PackedPlan, PlanDocument, Rendition, RenditionJob
from service.workers.process import address_space_bytes, limit_memory, serve_jobs, tell

# A worker that has grown by this share of its limit is replaced, so that memory kept by libraries does not fail the
# next file.
_WORN = 0.5


@dataclass(frozen=True)
class ImportJob:
    """Uploaded plan file, and the options of its import.

    Attributes:
        every_level: import all levels of the file, not the only one.
        building: name for plans that have none, and for those of several levels, see `import_plans`.
        tells_steps: tell the steps of the import as they begin: a few, and one for each level.
    """

    content: bytes
    options: ImportOptions
    step_m: float
    every_level: bool = False
    building: str | None = None
    tells_steps: bool = False


@dataclass(frozen=True)
class ParseJob:
    """Stored plan that the service is about to use."""

    document: PlanDocument


@dataclass(frozen=True)
class Imported:
    """Plan of a level of a file.

    Attributes:
        description: result of `describe_content` for a large plan; None for others.
    """

    plan: PackedPlan
    level: Level | None
    document: PlanDocument
    report: str
    media_type: str
    description: Rendition | None


ConversionJob = ImportJob | RenditionJob | ParseJob
ConversionResult = tuple[Imported, ...] | Rendition | PackedPlan


def report_of(imported: ImportedPlan) -> str:
    """Return the report of an import, with the storey of the plan, as JSON text."""
    level = imported.level
    storey = None
    if level is not None:
        storey = {"name": level.name, "number": level.number, "elevation_m": level.elevation_m}
    return json.dumps(imported.report.to_dict() | {"level": storey})


def run_converter(connection: Connection, limits: ImportLimits, memory_bytes: int) -> None:
    """Run import and export jobs until the pipe closes.

    `memory_bytes` limits the memory for a file, including the libraries that read it.
    """
    # One thread, because every thread reserves its own part of the limited memory.
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    begin_bytes = address_space_bytes()
    limit_memory(memory_bytes)

    def is_fit() -> bool:
        return address_space_bytes() - begin_bytes < _WORN * memory_bytes

    serve_jobs(connection, lambda: _converting(limits, connection), is_fit)


def _converting(limits: ImportLimits, connection: Connection) -> Callable[[ConversionJob], ConversionResult]:
    def convert(job: ConversionJob) -> ConversionResult:
        try:
            match job:
                case ImportJob():
                    return _import(job, limits, partial(tell, connection) if job.tells_steps else None)
                case RenditionJob():
                    # Imported late: its libraries take memory that imports do not need.
                    from service.plan_files.renditions import make_rendition

                    return make_rendition(job)
                case ParseJob():
                    return _parse(job)
        except MemoryError:
            raise InvalidFloorPlanError(
                "reading the file exceeds the memory limit (LALALOC_IMPORT_MEMORY_BYTES): simplify the file, or "
                "raise the limit"
            ) from None

    return convert


def _import(job: ImportJob, limits: ImportLimits, on_step: OnStep | None) -> tuple[Imported, ...]:
    if not job.every_level:
        plan = import_plan(job.content, job.options, limits, building=job.building, on_step=on_step)
        return (_imported(plan, job, limits),)
    plans = import_plans(job.content, job.options, limits, building=job.building, on_step=on_step)
    return tuple(_imported(plan, job, limits) for plan in plans)


def _imported(imported: ImportedPlan, job: ImportJob, limits: ImportLimits) -> Imported:
    plan = imported.plan(limits.plan)
    document, report = PlanDocument.from_plan(plan), report_of(imported)
    description = None
    if len(document.document) > LARGE:
        # Imported late for the same reason.
        from service.plan_files.renditions import describe_content

        description = describe_content(plan, report, job.step_m)
    media_type = detect_media_type(job.content, imported.report.format)
    return Imported(PackedPlan.of(plan), imported.level, document, report, media_type, description)


def _parse(job: ParseJob) -> PackedPlan:
    plan = job.document.plan()
    if plan is None:
        raise DamagedDataError("the stored document of a floor plan is damaged")
    return PackedPlan.of(plan)
