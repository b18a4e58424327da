"""Pool of worker processes that import and export plan files, limited in memory and time.

Large libraries, some of them in C++, read drawings, models and scans. A file that kills its worker is tried once more;
a file that takes too long is not. The workers start with the first file that is not in the native format.

Localisability is predicted and drawn by a worker of its own, started with the first prediction. It is not niced, as its
jobs hold cores like queries.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import Future, wait
from typing import NoReturn

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, OnStep
from service import errors
from service.plan_documents import LARGE, PREDICTIONS, PackedPlan, PlanDocument, Rendition, RenditionJob, RenditionKind
from service.plan_files.convert_worker import (
    ConversionJob,
    ConversionResult,
    Imported,
    ImportJob,
    ParseJob,
    run_converter,
)
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry

_Pool = WorkerPool[ConversionJob, ConversionResult]

# Largest number of waiting files.
_QUEUE = 16
# A worker that spends longer than `max_import_s` plus this margin on a file is replaced.
_STALL_MARGIN_S = 10.0
# Beside busy cores, a worker gets a tenth of the time of a query.
_NICE = 10
# Time (s) that a stored plan waits for a worker that parses it.
_PARSE_S = 10.0
# Time limit (s) of a prediction, which takes seconds on an idle core.
_PREDICTION_S = 300.0


class Converter:
    """Pool of conversion workers with a bounded queue. Thread-safe."""

    def __init__(self, settings: Settings, telemetry: Telemetry) -> None:
        self._settings = settings

        def pool(name: str, workers: int, stall_s: float, nice: int = 0) -> _Pool:
            arguments = (settings.plans.import_limits, settings.imports.memory_bytes)
            return WorkerPool(
                WorkerSpec(name, run_converter, arguments, stall_s=stall_s, nice=nice),
                workers=workers,
                queue_limit=_QUEUE,
                keep_spare=name == "import",
                accounts=telemetry.cpu_accounts,
                on_restart=lambda _reason: telemetry.pool_restarts.labels(name).inc(),
            )

        stall_s = settings.plans.max_import_s + _STALL_MARGIN_S
        self._importing = pool("import", settings.imports.workers, stall_s, _NICE)
        self._predicting = pool("prediction", 1, _PREDICTION_S)
        self._pools = self._importing, self._predicting
        telemetry.gauge(
            "lalaloc_import_queue_depth",
            "Plan files waiting for a worker.",
            lambda: sum(pool.waiting for pool in self._pools),
        )
        telemetry.gauge(
            "lalaloc_import_workers_resident_bytes",
            "Memory of all import workers.",
            lambda: sum(pool.resident_bytes for pool in self._pools),
        )

    @property
    def state(self) -> PoolState:
        """Number of workers wanted and ready; no worker is ready before the first file."""
        return self._importing.state

    def read(
        self,
        content: bytes,
        options: ImportOptions,
        client: str,
        *,
        every_level: bool = False,
        building: str | None = None,
        on_step: OnStep | None = None,
    ) -> tuple[Imported, ...]:
        """Import a plan file. Blocks for up to twice `max_import_s`.

        `building` names plans that have no name, and those of several levels. `on_step` is called with steps of the
        import as they begin, on another thread, and returns at once.
        """
        step_m, limit_s = self._settings.grids.grid_step_m, self._settings.plans.import_deadline_s
        job = ImportJob(content, options, step_m, every_level, building, tells_steps=on_step is not None)
        try:
            result = self._run(job, limit_s, client, on_step)
        except JobLostError as error:
            self._raise_lost(error)
        assert isinstance(result, tuple)
        return result

    def parse(self, document: PlanDocument) -> FloorPlan | None:
        """Return a stored plan, None if it is damaged. A worker parses a large one, unless none is free. Blocks."""
        if len(document.document) <= LARGE:
            return document.plan()
        try:
            result = self._run(ParseJob(document), _PARSE_S)
        except JobLostError:
            return document.plan()
        except (errors.DamagedDataError, InvalidFloorPlanError):
            return None
        assert isinstance(result, PackedPlan)
        return result.plan()

    def begin_rendition(self, job: RenditionJob, client: str) -> Future[ConversionResult]:
        """Queue a file that is made from a stored plan. Blocks while the plan is copied."""
        try:
            if job.kind in PREDICTIONS:
                return self._predicting.submit(job, _PREDICTION_S, client)
            return self._importing.submit(job, self._settings.plans.import_deadline_s, client)
        except JobLostError as error:
            self._raise_lost(error)

    async def rendition(self, begun: Future[ConversionResult], kind: RenditionKind) -> Rendition:
        """Wait for a file of `begin_rendition`; cancelling takes it out of the queue."""
        predicts = kind in PREDICTIONS
        try:
            async with asyncio.timeout(None if predicts else self._settings.plans.import_deadline_s):
                result = await asyncio.wrap_future(begun)
        except (TimeoutError, JobLostError) as error:
            lost = error if isinstance(error, JobLostError) else JobLostError("deadline")
            if predicts and lost.reason not in ("not-ready", "closing"):
                raise errors.DeadlineExceededError(_PREDICTION_S, "the localisability was not predicted") from error
            self._raise_lost(lost)
        assert isinstance(result, Rendition)
        return result

    def close(self) -> None:
        """Stop all workers and wait for them."""
        for pool in self._pools:
            pool.close()

    def _run(
        self, job: ConversionJob, limit_s: float, client: str = "", on_step: OnStep | None = None
    ) -> ConversionResult:
        """Run a job of the imports, and wait for it; `on_step` is called with its news."""
        future = self._importing.submit(job, limit_s, client, on_step or (lambda _step: None))
        done, _ = wait([future], limit_s)
        if not done:
            future.cancel()
            raise JobLostError("deadline")
        return future.result()

    def _raise_lost(self, error: JobLostError) -> NoReturn:
        settings = self._settings
        match error.reason:
            case "poisoned":
                raise InvalidFloorPlanError(
                    "the file could not be read: two attempts ended before the end of it; save it again, export a "
                    "smaller part, or use another format"
                ) from error
            case "stalled":
                raise InvalidFloorPlanError(
                    f"reading the file took more than {settings.plans.max_import_s + _STALL_MARGIN_S:g} s of CPU time "
                    f"(max_import_s is {settings.plans.max_import_s:g}); export a single storey, or fewer layers"
                ) from error
            case "fault":
                raise InvalidFloorPlanError(
                    "the file is damaged or has an unsupported structure; save it again, or in another format"
                ) from error
            case "queue-full":
                raise errors.OverloadedError(_QUEUE) from error
            case "not-ready" | "stopped":
                raise errors.ConverterNotReadyError from error
            case "closing":
                raise errors.StoppingError from error
            case "deadline" | "died":
                raise errors.DeadlineExceededError(
                    settings.plans.import_deadline_s, "the plan file was not read or written"
                ) from error
