"""Pool of worker processes, bounded in memory and time, that decode photographs and rasterise drawings.

A picture that crashes its worker is tried once more; one that exceeds the time limit is not. Other jobs are not
affected. No client keeps all workers busy.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.bundle import Manifest
from lalaloc_core.errors import InvalidFilmError, InvalidPhotographError
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film
from lalaloc_core.photograph.photograph import Purpose
from lalaloc_core.photograph.turn_angles import TurnAngles
from service import errors
from service.capacity.fair_share import FairSemaphore
from service.decoding.decode_worker import DecodeJob, Decoding, run_decoder
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry
from service.uploaded_file import UploadedFile

# Page about usable photographs, named in refusals.
_HELP = "docs/how-to/take-photographs.md"
# Photographs that can wait to be decoded.
_QUEUE = 32
# Films that can wait, and the CPU time (s) of finding the angles of a film's frames.
_FILM_QUEUE, _FILM_MARGIN_S = 4, 40.0


class Decoder:
    """Bounded pool of decoding workers."""

    def __init__(self, manifest: Manifest, settings: Settings, telemetry: Telemetry, cores: FairSemaphore) -> None:
        self._settings = settings
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
        self._films_started, self._lock = False, threading.Lock()
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
        """Start all workers and return at once."""
        self._pool.start()

    @property
    def state(self) -> PoolState:
        """Numbers of workers, all and warm."""
        return self._pool.state

    async def decode(
        self,
        content: bytes | UploadedFile | Photograph,
        stated: StatedCamera,
        deadline: float,
        client: str = "",
        *,
        purpose: Purpose = "single",
    ) -> Photograph:
        """Decode an uploaded photograph for the encoders; one that is encoded already is returned as it is.

        The deadline is a time (`monotonic`).

        Raises:
            InvalidPhotographError: see `open_photograph`; or the file stalled a worker, or crashed two.
        """
        if isinstance(content, Photograph):
            return content
        return await self._run_job(DecodeJob("photograph", (content, stated, purpose)), deadline, client)

    async def film(self, content: bytes | UploadedFile, stated: StatedCamera, deadline: float, client: str) -> Film:
        """Read a film of a turn; the first one starts the workers."""
        with self._lock:
            if not self._films_started:
                self._films.start()
                self._films_started = True
        return await self._run_job(DecodeJob("film", (content, stated)), deadline, client)

    async def level_turn(
        self, photographs: Sequence[Photograph], deadline: float, client: str = ""
    ) -> tuple[list[Photograph], list[TurnAngles]]:
        """Return photographs of one spot, decoded for a turn, with the angles that their overlap tells."""
        return await self._run_job(DecodeJob("turn", (photographs,)), deadline, client)

    async def picture(
        self,
        content: bytes | UploadedFile,
        stated: StatedCamera,
        deadline: float,
        client: str,
        *,
        is_sphere: bool,
        max_size: tuple[int, int],
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Decode a photograph to show: upright within `max_size` (width, height), spheres level and of that size."""
        return await self._run_job(DecodeJob("picture", (content, stated, is_sphere, max_size)), deadline, client)

    async def rasterise(self, svg: str, deadline: float, client: str = "") -> bytes:
        """Return a drawing as a PNG file, by a deadline (`monotonic`)."""
        return await self._run_job(DecodeJob("drawing", (svg,)), deadline, client)

    async def _run_job(self, job: DecodeJob, deadline: float, client: str) -> Any:
        try:
            pool = self._films if job.task == "film" else self._pool
            return await pool.run_job(job, max(deadline - monotonic(), 0.0), client)
        except JobLostError as error:
            raise self._error(error, job) from error
        except (InvalidPhotographError, InvalidFilmError) as error:
            raise type(error)(f"{error}; see {_HELP}") from error

    def close(self) -> None:
        """End all workers and wait for them."""
        self._pool.close()
        with self._lock:
            if self._films_started:
                self._films.close()
            self._films_started = True

    def _error(self, lost: JobLostError, job: DecodeJob) -> Exception:
        """Return the service's error for a lost job."""
        if job.task == "drawing" and lost.reason in ("poisoned", "fault"):
            return errors.DrawingFailedError(lost.reason)
        if job.task == "drawing" and lost.reason == "stalled":
            # Drawings have a bounded size, so the machine is slow.
            return errors.DeadlineExceededError(self._settings.decode.stall_s)
        if job.task == "film" and (fault := self._film_fault(lost)) is not None:
            return InvalidFilmError(fault)
        match lost.reason:
            case "poisoned":
                return InvalidPhotographError("the photograph crashed the decoder twice: save it anew or smaller")
            case "stalled":
                return InvalidPhotographError(
                    f"decoding the photograph took more than {self._settings.decode.stall_s:g} s of CPU time "
                    "(decode_stall_s): save it anew, or send a smaller one"
                )
            case "fault":
                return InvalidPhotographError("the photograph is damaged: save it anew")
            case "queue-full":
                return errors.OverloadedError(_QUEUE)
            case "not-ready" | "stopped":
                return errors.DecoderNotReadyError()
            case "closing":
                return errors.StoppingError()
            case "deadline" | "died":
                return errors.DeadlineExceededError(self._settings.requests.request_deadline_s)

    def _film_fault(self, lost: JobLostError) -> str | None:
        """Return the fault of a film that a worker could not read; None if the film is not to blame."""
        return {
            "poisoned": "the film crashed the decoder twice: export it anew",
            "stalled": f"reading the film took more than {self._film_stall_s:g} s of CPU time "
            "(max_film_cpu_s): send a film with fewer pixels, or a shorter one",
            "fault": "the film is damaged: export it anew",
        }.get(lost.reason)
