"""Decoding panoramas, and making pixels of drawings, in worker processes that are bounded in memory and time.

A picture that kills such a process gets a second try, one that takes too long none, and neither harms anything else.
No client keeps all the processes busy.
"""

from __future__ import annotations

from time import monotonic

from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.localise.bundle import Manifest
from lalaloc_core.panorama.images import Panorama
from service.errors import (
    DeadlineExceededError,
    DecoderNotReadyError,
    DrawingFailedError,
    OverloadedError,
    StoppingError,
)
from service.pools import JobLostError, PoolState, WorkerPool, WorkerSpec
from service.settings import Settings
from service.telemetry import Telemetry
from service.workers.decode import DecodeJob, DecodeRefusal, RasteriseJob, run_decoder

# Panoramas that can wait to be decoded.
_QUEUE = 32


class Decoder:
    """Bounded pool of decoding workers."""

    def __init__(self, manifest: Manifest, settings: Settings, telemetry: Telemetry) -> None:
        self._settings = settings
        self._size = manifest.image_height, manifest.image_width
        self._pool: WorkerPool[DecodeJob | RasteriseJob, Panorama | DecodeRefusal | bytes] = WorkerPool(
            WorkerSpec(
                "decode",
                run_decoder,
                (
                    manifest.image_height,
                    manifest.image_width,
                    settings.panoramas.panorama_limits,
                    settings.decode.memory_bytes,
                ),
                stall_s=settings.decode.stall_s,
            ),
            workers=settings.decode.workers,
            queue_limit=_QUEUE,
            keep_spare=True,
            on_restart=lambda _reason: telemetry.note_restart("decode"),
        )
        telemetry.gauge(
            "lalaloc_decode_queue_depth", "Panoramas waiting for a decoding worker.", lambda: self._pool.waiting
        )
        telemetry.gauge(
            "lalaloc_decode_workers_ready", "Decoding workers that are warm.", lambda: self._pool.state.ready
        )

        telemetry.gauge(
            "lalaloc_decode_workers_resident_bytes",
            "Memory of all decoding workers.",
            lambda: self._pool.resident_bytes,
        )

    def start(self) -> None:
        """Start all workers; returns at once."""
        self._pool.start()

    @property
    def state(self) -> PoolState:
        """How many workers are wanted and warm."""
        return self._pool.state

    async def decode(
        self, content: bytes, deadline: float, client: str = "", *, size: tuple[int, int] | None = None
    ) -> Panorama:
        """The panorama in an uploaded file, by a deadline (`monotonic`).

        Args:
            size: height and width of its pixels; by default the encoder's.

        Raises:
            InvalidPanoramaError: see `open_panorama`; or a worker stalled over it, or two died.
            OverloadedError: too many panoramas wait already.
            DeadlineExceededError: it was not decoded in time.
            DecoderNotReadyError: no worker is running, nor will be in time.
            StoppingError: the service is shutting down.
        """
        height, width = size or self._size
        answer = await self._answer(DecodeJob(content, height, width), deadline, client)
        if isinstance(answer, DecodeRefusal):
            raise InvalidPanoramaError(answer.reason)
        assert isinstance(answer, Panorama)
        return answer

    async def rasterise(self, svg: str, deadline: float, client: str = "") -> bytes:
        """A drawing as PNG, by a deadline (`monotonic`).

        Raises:
            OverloadedError, DeadlineExceededError, DecoderNotReadyError, StoppingError: as `decode`.
        """
        answer = await self._answer(RasteriseJob(svg), deadline, client)
        assert isinstance(answer, bytes)
        return answer

    async def _answer(
        self, job: DecodeJob | RasteriseJob, deadline: float, client: str
    ) -> Panorama | DecodeRefusal | bytes:
        try:
            return await self._pool.answer(job, max(deadline - monotonic(), 0.0), client)
        except JobLostError as error:
            raise self._explained(error, job) from error

    def close(self) -> None:
        """End all workers and wait for them."""
        self._pool.close()

    def _explained(self, error: JobLostError, job: DecodeJob | RasteriseJob) -> Exception:
        if isinstance(job, RasteriseJob) and error.reason in ("poisoned", "fault"):
            return DrawingFailedError(error.reason)
        if isinstance(job, RasteriseJob) and error.reason == "stalled":
            # Drawings are of bounded size: it is the machine that is slow.
            return DeadlineExceededError(self._settings.decode.stall_s)
        match error.reason:
            case "poisoned":
                return InvalidPanoramaError(
                    "the panorama could not be decoded: twice that ended the process that tried"
                )
            case "stalled":
                return InvalidPanoramaError(
                    f"decoding the panorama took longer than {self._settings.decode.stall_s:g} s (decode_stall_s); a "
                    "smaller one, or one that is saved anew, takes less"
                )
            case "fault":
                return InvalidPanoramaError("the panorama is damaged")
            case "queue-full":
                return OverloadedError(_QUEUE)
            case "not-ready":
                return DecoderNotReadyError()
            case "closing":
                return StoppingError()
            case "deadline" | "died":
                return DeadlineExceededError(self._settings.requests.request_deadline_s)
