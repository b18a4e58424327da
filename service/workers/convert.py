"""The body of a conversion worker process: the only place of the service that reads drawings and models.

From `ImportJob` to `Imported`, from `ExportJob` to bytes, or to the `ConversionRefusal` of what cannot be read or
written. The libraries of a format are loaded with its first file; `service.workers.process` has the rest.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Literal

from lalaloc_core.errors import InvalidFloorPlanError, MissingExtraError, SeveralLevelsError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import (
    ImportedPlan,
    ImportLimits,
    ImportOptions,
    export_plan,
    import_plan,
    media_type_of,
)
from service.workers.process import address_space_bytes, limit_memory, serve_jobs

# A worker that has grown by this share of what it may is replaced: what libraries keep must not stand in the way of
# the next file.
_WORN = 0.5


@dataclass(frozen=True)
class ImportJob:
    """A file of a plan, and what was said about it."""

    content: bytes
    options: ImportOptions


@dataclass(frozen=True)
class ExportJob:
    """A plan, as the store has it, that is to be written in a format."""

    document: str
    format: str


@dataclass(frozen=True)
class Imported:
    """What was understood of a file.

    Attributes:
        document: the plan in the native format, which whoever gets it validates: it comes from a process that read
            a stranger's file.
        report: of the import, as JSON has it.
        media_type: of the file.
    """

    document: dict[str, Any]
    report: dict[str, Any]
    media_type: str


@dataclass(frozen=True)
class ConversionRefusal:
    """Why a file is no plan, or a plan no such file; `kind` says which error that is."""

    reason: str
    kind: Literal["invalid", "levels", "extra"] = "invalid"
    room: str | None = None
    # Names of levels, or the one of an extra with what it is needed for.
    names: tuple[str, ...] = field(default=())

    @classmethod
    def of(cls, error: InvalidFloorPlanError | MissingExtraError) -> ConversionRefusal:
        """The refusal that an error is."""
        if isinstance(error, MissingExtraError):
            return cls(str(error), "extra", names=(error.what, error.extra))
        if isinstance(error, SeveralLevelsError):
            return cls(error.reason, "levels", names=error.levels)
        return cls(error.reason, room=error.room)

    def error(self) -> InvalidFloorPlanError | MissingExtraError:
        """The error again."""
        if self.kind == "extra":
            return MissingExtraError(*self.names)
        if self.kind == "levels":
            return SeveralLevelsError(self.names)
        return InvalidFloorPlanError(self.reason, room=self.room)


def report_of(imported: ImportedPlan) -> dict[str, Any]:
    """The report of an import, with the storey that the plan is of, as JSON has it."""
    level = imported.level
    told = None
    if level is not None:
        told = {"name": level.name, "number": level.number, "elevation_m": level.elevation_m}
    return imported.report.to_dict() | {"level": told}


def run_converter(connection: Connection, limits: ImportLimits, memory_bytes: int) -> None:
    """Answer files with plans, and plans with files.

    Args:
        memory_bytes: what a file may need, the libraries that read it included.
    """
    # One thread: each has room of its own in what may be used.
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    begin_bytes = address_space_bytes()
    limit_memory(memory_bytes)

    def is_fit() -> bool:
        return address_space_bytes() - begin_bytes < _WORN * memory_bytes

    serve_jobs(connection, lambda: _converting(limits), is_fit)


def _converting(limits: ImportLimits) -> Callable[[ImportJob | ExportJob], Imported | bytes | ConversionRefusal]:
    def convert(job: ImportJob | ExportJob) -> Imported | bytes | ConversionRefusal:
        try:
            return _export(job) if isinstance(job, ExportJob) else _import(job, limits)
        except (InvalidFloorPlanError, MissingExtraError) as error:
            return ConversionRefusal.of(error)
        except MemoryError:
            return ConversionRefusal(
                "the file takes more memory than there is for one (import_memory_bytes); make it simpler"
            )

    return convert


def _import(job: ImportJob, limits: ImportLimits) -> Imported:
    imported = import_plan(job.content, job.options, limits)
    media_type = media_type_of(job.content, imported.report.format)
    return Imported(_plain(imported.document), report_of(imported), media_type)


def _export(job: ExportJob) -> bytes:
    return export_plan(FloorPlan.from_stored(job.document, ()), job.format)


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """As JSON has it, without types of any library."""
    return json.loads(json.dumps(document))
