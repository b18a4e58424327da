"""Pools of worker processes, bounded in memory and time, that decode and copy photographs, and draw.

A picture that crashes its worker is tried once more; one that exceeds the time limit is not. Other jobs are not
affected. No client keeps all workers busy.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.bundle import Manifest
from lalaloc_core.draw.pins import DPI, THUMBNAIL
from lalaloc_core.errors import InvalidFilmError, InvalidPhotographError
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film
from lalaloc_core.photograph.photograph import Purpose
from lalaloc_core.photograph.placed_copy import Place, PlacedHead
from lalaloc_core.photograph.turn_angles import TurnAngles
from service import errors
from service.capacity.cores import usable_cores
from service.capacity.fair_share import FairSemaphore
from service.decoding.decode_worker import DecodeJob, Decoding, run_decoder
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.query_context import QueryContext
from service.settings import Settings
from service.telemetry import Telemetry
from service.uploaded_file import UploadedFile

# Page about usable photographs, named in refusals.
_HELP = "docs/how-to/take-photographs.md"
# Photographs that can wait to be decoded.
_QUEUE = 32
# Films that can wait, and the CPU time (s) of finding the angles of a film's frames.
_FILM_QUEUE, _FILM_MARGIN_S = 4, 40.0
# Largest turn whose angles take no longer than decoding a photograph; those of more are found where films are read.
_SHORT_TURN = 10
_FAULTS = tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8"))


class Decoder:
    """Bounded pool of decoding workers."""

    def __init__(self, manifest: Manifest, settings: Settings, telemetry: Telemetry, cores: FairSemaphore) -> None:
        self._settings, self._cores = settings, cores
        decoding = Decoding(
            sphere=sphere_size(manifest),
            patch=patch_size(manifest),
            limits=settings.photographs.photograph_limits,
            film_limits=settings.photographs.film_limits,
        )

        def pool(name: str, stall_s: float, workers: int, queue_limit: int) -> WorkerPool[DecodeJob, Any]:
            arguments = decoding, settings.decode.memory_bytes
            return WorkerPool(
                WorkerSpec(name, run_decoder, arguments, stall_s=stall_s),
                workers=workers,
                queue_limit=queue_limit,
                keep_spare=True,
                accounts=telemetry.cpu_accounts,
                cores=cores,
                on_restart=lambda _reason: telemetry.pool_restarts.labels(name).inc(),
            )

        self._pool = pool("decode", settings.decode.stall_s, settings.decode.workers, _QUEUE)
        # Films take so long that photographs must not wait for them.
        self._film_stall_s = settings.photographs.max_film_cpu_s + _FILM_MARGIN_S
        self._films = pool("film", self._film_stall_s, settings.decode.film_workers, _FILM_QUEUE)
        self._long_jobs = 0
        telemetry.gauge(
            "lalaloc_decode_queue_depth", "Photographs waiting for a decoding worker.", lambda: self._pool.waiting
        )
        telemetry.gauge(
            "lalaloc_decode_workers_ready", "Decoding workers that are ready.", lambda: self._pool.state.ready
        )
        telemetry.gauge(
            "lalaloc_decode_workers_resident_bytes",
            "Memory of all decoding workers.",
            lambda: self._pool.resident_bytes,
        )

    def start(self) -> None:
        """Start all workers but those of films, and return at once."""
        self._pool.start()

    @property
    def state(self) -> PoolState:
        """Numbers of workers, all and warm."""
        return self._pool.state

    async def decode(
        self,
        content: bytes | UploadedFile | Photograph,
        stated: StatedCamera,
        context: QueryContext,
        *,
        purpose: Purpose = "single",
    ) -> Photograph:
        """Decode an uploaded photograph for the encoders; one that is encoded already is returned as it is.

        Raises:
            InvalidPhotographError: see `open_photograph`; or the file stalled a worker, or crashed two.
        """
        if isinstance(content, Photograph):
            return content
        return await self._run_job(DecodeJob("photograph", (content, stated, purpose)), context)

    async def film(self, content: bytes | UploadedFile, stated: StatedCamera, context: QueryContext) -> Film:
        """Read a film of a turn, with a second thread if a core beside its own is idle."""
        threads = 2 if self._cores.in_use + 1 < usable_cores() else 1
        return await self._run_job(DecodeJob("film", (content, stated, threads)), context)

    async def level_turn(
        self, photographs: Sequence[Photograph], context: QueryContext
    ) -> tuple[list[Photograph], list[TurnAngles]]:
        """Return photographs of one spot, decoded for a turn, with the angles that their overlap tells."""
        return await self._run_job(DecodeJob("turn", (photographs,)), context)

    async def picture(
        self,
        content: bytes | UploadedFile,
        stated: StatedCamera,
        context: QueryContext,
        *,
        is_sphere: bool,
        max_size: tuple[int, int],
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Decode a photograph to show: upright within `max_size` (width, height), spheres level and of that size."""
        return await self._run_job(DecodeJob("picture", (content, stated, is_sphere, max_size)), context)

    async def copy(self, content: UploadedFile, place: Place, context: QueryContext) -> tuple[PlacedHead, bytes]:
        """Return the beginning of a copy of a photograph with its place, and a JPEG of it for the report."""
        return await self._run_job(DecodeJob("copy", (content, place, THUMBNAIL)), context)

    async def report(self, pages: Callable[[], Iterable[str]], context: QueryContext) -> bytes:
        """Return the pages of a report as a PDF file; the function that draws them is picklable."""
        return await self._run_job(DecodeJob("report", (pages, DPI)), context)

    async def rasterise(self, svg: str, context: QueryContext) -> bytes:
        """Return a drawing as a PNG file."""
        return await self._run_job(DecodeJob("drawing", (svg,)), context)

    async def _run_job(self, job: DecodeJob, context: QueryContext) -> Any:
        # Photographs of a turn also go where films are read, on another core, if that is idle.
        is_idle = not self._long_jobs and self._films.state.ready > 0
        is_long = _is_long(job) or (is_idle and job.task == "photograph" and job.arguments[2] == "turn")
        self._long_jobs += is_long
        try:
            return await (self._films if is_long else self._pool).run_job(job, max(context.left_s, 0.0), context.client)
        except JobLostError as error:
            raise self._error(error, job, is_long, context) from error
        except (InvalidPhotographError, InvalidFilmError) as error:
            raise type(error)(f"{error}; see {_HELP}") from error
        finally:
            self._long_jobs -= is_long

    def close(self) -> None:
        """End all workers and wait for them."""
        self._pool.close()
        self._films.close()

    def _error(self, lost: JobLostError, job: DecodeJob, is_long: bool, context: QueryContext) -> Exception:
        """Return the service's error for a lost job."""
        stall_s = self._film_stall_s if is_long else self._settings.decode.stall_s
        match lost.reason:
            case "stalled" if job.task == "drawing":
                # Drawings have a bounded size, so the machine is slow.
                return errors.DeadlineExceededError(stall_s)
            case "stalled" if job.task == "report":
                return errors.DeadlineExceededError(stall_s, "the report of so many photographs was not drawn")
            case "poisoned" | "fault" if job.task in ("drawing", "report"):
                return errors.DrawingFailedError(lost.reason)
            case "poisoned" | "stalled" | "fault":
                kind = InvalidFilmError if job.task == "film" else InvalidPhotographError
                return kind(_FAULTS.get(job.task, _FAULTS["photograph"])[lost.reason].format(stall_s))
            case "queue-full":
                return errors.OverloadedError(_FILM_QUEUE if is_long else _QUEUE)
            case "not-ready" | "stopped":
                return errors.DecoderNotReadyError()
            case "closing":
                return errors.StoppingError()
            case "deadline" | "died":
                return errors.DeadlineExceededError(context.limit_s)


def _is_long(job: DecodeJob) -> bool:
    """Return whether a job can take as long as a film."""
    return job.task in ("film", "report") or (job.task == "turn" and len(job.arguments[0]) > _SHORT_TURN)
