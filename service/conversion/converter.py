"""Reading and writing the files of plans in worker processes, bounded in memory and time.

Drawings, models and scans are read by large libraries, some of them in C++: a file that kills such a process gets a
second try, one that takes too long none, and neither harms anything else. The workers start with the first file: a
service that is sent nothing but the native format does without.
"""

from __future__ import annotations

import json
import threading
from concurrent.futures import wait
from typing import NoReturn

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions
from service.errors import ConverterNotReadyError, DeadlineExceededError, OverloadedError, StoppingError
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry
from service.workers.convert import ConversionRefusal, ExportJob, Imported, ImportJob, run_converter

_Pool = WorkerPool[ImportJob | ExportJob, Imported | bytes | ConversionRefusal]

# Files that can wait for a process.
_QUEUE = 16
# A process that reads one file for longer than `max_import_s` and this is replaced.
_STALL_MARGIN_S = 10.0


class Converter:
    """Bounded pool of converting workers; may be used from any thread."""

    def __init__(self, settings: Settings, telemetry: Telemetry) -> None:
        self._settings = settings
        self._telemetry = telemetry
        self._pool: _Pool | None = None
        self._lock = threading.Lock()
        self._closed = False
        telemetry.gauge(
            "lalaloc_import_queue_depth", "Files of plans waiting for a worker.", lambda: self._count("waiting")
        )
        telemetry.gauge(
            "lalaloc_import_workers_resident_bytes",
            "Memory of all workers that read files of plans.",
            lambda: self._count("resident_bytes"),
        )

    @property
    def state(self) -> PoolState:
        """How many workers are wanted and warm; none are before the first file."""
        pool = self._pool
        if pool is None:
            return PoolState(workers=self._settings.imports.workers, ready=0, warmed_up=False, fault=None)
        return pool.state

    def read(self, content: bytes, options: ImportOptions, client: str) -> Imported:
        """What there is in the file of a plan; blocks, for twice `max_import_s` at most.

        Raises:
            InvalidFloorPlanError, SeveralLevelsError: what is wrong with the file, and what to do; or a worker stalled
                over it, or two died.
            MissingExtraError: what reads its format is not installed.
            OverloadedError: too many files wait already.
            DeadlineExceededError: it was not read in time.
            ConverterNotReadyError: no worker is running, nor will be in time.
            StoppingError: the service is shutting down.
        """
        limit_s = self._settings.plans.import_deadline_s
        try:
            future = self._started().submit(ImportJob(content, options), limit_s, client)
            done, _ = wait([future], limit_s)
            if not done:
                future.cancel()
                raise JobLostError("deadline")
            answer = future.result()
        except JobLostError as error:
            self._lost(error)
        if isinstance(answer, ConversionRefusal):
            raise answer.error()
        assert isinstance(answer, Imported)
        return answer

    async def write(self, plan: FloorPlan, format: str, client: str) -> bytes:
        """A plan as the file of another tool.

        Args:
            format: one of `lalaloc_core.importers.EXPORT_FORMATS`.

        Raises:
            InvalidFloorPlanError: the plan has not what the format needs.
            MissingExtraError, OverloadedError, DeadlineExceededError, ConverterNotReadyError, StoppingError: as `read`.
        """
        job = ExportJob(json.dumps(plan.to_dict()), format)
        try:
            answer = await self._started().run_job(job, self._settings.plans.import_deadline_s, client)
        except JobLostError as error:
            self._lost(error)
        if isinstance(answer, ConversionRefusal):
            raise answer.error()
        assert isinstance(answer, bytes)
        return answer

    def close(self) -> None:
        """End all workers and wait for them."""
        with self._lock:
            self._closed = True
        if self._pool is not None:
            self._pool.close()

    def _started(self) -> _Pool:
        """The pool, which the first to ask for it starts."""
        with self._lock:
            if self._closed:
                raise JobLostError("closing")
            if self._pool is None:
                settings = self._settings
                spec = WorkerSpec(
                    "import",
                    run_converter,
                    (settings.plans.import_limits, settings.imports.memory_bytes),
                    stall_s=settings.plans.max_import_s + _STALL_MARGIN_S,
                )
                self._pool = WorkerPool(
                    spec,
                    workers=settings.imports.workers,
                    queue_limit=_QUEUE,
                    keep_spare=True,
                    on_restart=lambda _reason: self._telemetry.note_restart("import"),
                )
                self._pool.start()
            return self._pool

    def _count(self, name: str) -> float:
        return 0 if self._pool is None else getattr(self._pool, name)

    def _lost(self, error: JobLostError) -> NoReturn:
        settings = self._settings
        match error.reason:
            case "poisoned":
                raise InvalidFloorPlanError(
                    "the file could not be read: twice that ended the process that tried, perhaps for want of memory "
                    f"({settings.imports.memory_bytes} bytes, import_memory_bytes); save it anew, smaller, or in "
                    "another format"
                ) from error
            case "stalled":
                raise InvalidFloorPlanError(
                    f"reading the file took longer than {settings.plans.max_import_s + _STALL_MARGIN_S:g} s (max_import_s is "
                    f"{settings.plans.max_import_s:g}); export only the layers that matter, or one storey"
                ) from error
            case "fault":
                raise InvalidFloorPlanError(
                    "the file is damaged, or drawn in a way that is not understood; save it anew, or in another format"
                ) from error
            case "queue-full":
                raise OverloadedError(_QUEUE) from error
            case "not-ready":
                raise ConverterNotReadyError from error
            case "closing":
                raise StoppingError from error
            case "deadline" | "died":
                raise DeadlineExceededError(
                    settings.plans.import_deadline_s, "the plan file was not read or written"
                ) from error
