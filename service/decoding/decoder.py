"""Pool of worker processes, bounded in memory and time, that decode photographs and rasterise drawings.

A picture that crashes its worker is tried once more; one that exceeds the time limit is not. Other jobs are not
affected. No client keeps all workers busy.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.bundle import Manifest
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.turn_angles import TurnAngles, TurnView
from service import errors
from service.capacity.fair_share import FairSemaphore
from service.decoding.decode_worker import (
    DecodeJob,
    DecodeRefusal,
    DecodeSizes,
    Job,
    RasteriseJob,
    Result,
    ShowJob,
    TurnJob,
    run_decoder,
)
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry
from service.uploaded_file import UploadedFile

# Page about usable photographs, named in refusals.
_HELP = "docs/how-to/take-photographs.md"
# Photographs that can wait to be decoded.
_QUEUE = 32


class Decoder:
    """Bounded pool of decoding workers."""

    def __init__(self, manifest: Manifest, settings: Settings, telemetry: Telemetry, permits: FairSemaphore) -> None:
        self._settings = settings
        self._pool: WorkerPool[Job, Result] = WorkerPool(
            WorkerSpec(
                "decode",
                run_decoder,
                (
                    DecodeSizes(sphere=sphere_size(manifest), patch=patch_size(manifest)),
                    settings.photographs.photograph_limits,
                    settings.decode.memory_bytes,
                ),
                stall_s=settings.decode.stall_s,
            ),
            workers=settings.decode.workers,
            queue_limit=_QUEUE,
            keep_spare=True,
            accounts=telemetry.cpu_accounts,
            permits=permits,
            on_restart=lambda _reason: telemetry.note_restart("decode"),
        )
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
        overview: bool = False,
    ) -> Photograph:
        """Decode an uploaded photograph for the encoders; one that is encoded already is returned as it is.

        Args:
            content: the file, or what was read of its features.
            stated: the request's statements about it.
            deadline: time limit (`monotonic`).
            client: fairness group of the job.
            overview: as in `open_photograph`.

        Raises:
            InvalidPhotographError: see `open_photograph`; or the file stalled a worker, or crashed two.
            OverloadedError: too many photographs wait already.
            DeadlineExceededError: the deadline passed.
            DecoderNotReadyError: no worker is running, nor will be by the deadline.
            StoppingError: the service is shutting down.
        """
        if isinstance(content, Photograph):
            return content
        result = await self._run_job(DecodeJob(content, stated, overview), deadline, client)
        assert isinstance(result, Photograph)
        return result

    async def angles(self, views: Sequence[TurnView], deadline: float, client: str = "") -> list[TurnAngles]:
        """Return the angles of photographs of one spot, by what they show twice.

        Raises:
            InvalidPhotographError: the photographs stalled a worker, or crashed two.
            OverloadedError, DeadlineExceededError, DecoderNotReadyError, StoppingError: as `decode`.
        """
        result = await self._run_job(TurnJob(views), deadline, client)
        assert isinstance(result, list)
        return result

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
        """Decode a photograph to be shown: upright within `max_size` (width, height), a sphere level and of that size.

        Raises:
            LaLaLocError: as `decode`.
        """
        result = await self._run_job(ShowJob(content, stated, is_sphere, max_size), deadline, client)
        assert isinstance(result, np.ndarray)
        return result

    async def rasterise(self, svg: str, deadline: float, client: str = "") -> bytes:
        """Return a drawing as a PNG file, by a deadline (`monotonic`).

        Raises:
            DrawingFailedError: the drawing crashed two workers, or could not be made.
            OverloadedError, DeadlineExceededError, DecoderNotReadyError, StoppingError: as `decode`.
        """
        result = await self._run_job(RasteriseJob(svg), deadline, client)
        assert isinstance(result, bytes)
        return result

    async def _run_job(self, job: Job, deadline: float, client: str) -> Result:
        try:
            result = await self._pool.run_job(job, max(deadline - monotonic(), 0.0), client)
        except JobLostError as error:
            raise self._error(error, job) from error
        if isinstance(result, DecodeRefusal):
            raise InvalidPhotographError(f"{result.reason}; see {_HELP}")
        return result

    def close(self) -> None:
        """End all workers and wait for them."""
        self._pool.close()

    def _error(self, lost: JobLostError, job: Job) -> Exception:
        """Return the service's error for a lost job."""
        if isinstance(job, RasteriseJob) and lost.reason in ("poisoned", "fault"):
            return errors.DrawingFailedError(lost.reason)
        if isinstance(job, RasteriseJob) and lost.reason == "stalled":
            # Drawings have a bounded size, so the machine is slow.
            return errors.DeadlineExceededError(self._settings.decode.stall_s)
        match lost.reason:
            case "poisoned":
                return InvalidPhotographError("the photograph crashed the decoder twice: save it anew or smaller")
            case "stalled":
                return InvalidPhotographError(
                    f"decoding the photograph took more than {self._settings.decode.stall_s:g} s of CPU time "
                    "(LALALOC_DECODE_STALL_S): save it anew, or send a smaller one"
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
