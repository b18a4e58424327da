"""Pool of worker processes, bounded in memory and time, that decode panoramas and rasterise drawings.

A picture that crashes its worker is tried once more; one that exceeds the time limit is not. Other jobs are not
affected. No client keeps all workers busy.
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
from service.tenancy.fair_share import FairSemaphore
from service.uploaded_file import UploadedFile
from service.workers.decode import DecodeJob, DecodeRefusal, RasteriseJob, run_decoder

# Panoramas that can wait to be decoded.
_QUEUE = 32


class Decoder:
    """Bounded pool of decoding workers."""

    def __init__(self, manifest: Manifest, settings: Settings, telemetry: Telemetry, permits: FairSemaphore) -> None:
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
            accounts=telemetry.cpu_accounts,
            permits=permits,
            on_restart=lambda _reason: telemetry.note_restart("decode"),
        )
        telemetry.gauge(
            "lalaloc_decode_queue_depth", "Panoramas waiting for a decoding worker.", lambda: self._pool.waiting
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
        self, content: bytes | UploadedFile, deadline: float, client: str = "", *, size: tuple[int, int] | None = None
    ) -> Panorama:
        """Decode an uploaded panorama file.

        Args:
            content: the file.
            deadline: time limit (`monotonic`).
            client: fairness group of the job.
            size: height and width of the result in pixels; None for the encoder's.

        Raises:
            InvalidPanoramaError: see `open_panorama`; or the file stalled a worker, or crashed two.
            OverloadedError: too many panoramas wait already.
            DeadlineExceededError: the deadline passed.
            DecoderNotReadyError: no worker is running, nor will be by the deadline.
            StoppingError: the service is shutting down.
        """
        height, width = size or self._size
        result = await self._run_job(DecodeJob(content, height, width), deadline, client)
        if isinstance(result, DecodeRefusal):
            raise InvalidPanoramaError(result.reason)
        assert isinstance(result, Panorama)
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

    async def _run_job(
        self, job: DecodeJob | RasteriseJob, deadline: float, client: str
    ) -> Panorama | DecodeRefusal | bytes:
        try:
            return await self._pool.run_job(job, max(deadline - monotonic(), 0.0), client)
        except JobLostError as error:
            raise self._error(error, job) from error

    def close(self) -> None:
        """End all workers and wait for them."""
        self._pool.close()

    def _error(self, lost: JobLostError, job: DecodeJob | RasteriseJob) -> Exception:
        """Return the service's error for a lost job."""
        if isinstance(job, RasteriseJob) and lost.reason in ("poisoned", "fault"):
            return DrawingFailedError(lost.reason)
        if isinstance(job, RasteriseJob) and lost.reason == "stalled":
            # Drawings have a bounded size, so the machine is slow.
            return DeadlineExceededError(self._settings.decode.stall_s)
        match lost.reason:
            case "poisoned":
                return InvalidPanoramaError("the panorama crashed the decoder twice: save it anew, or make it smaller")
            case "stalled":
                return InvalidPanoramaError(
                    f"decoding the panorama took longer than {self._settings.decode.stall_s:g} s "
                    "(LALALOC_DECODE_STALL_S): save it anew, or send a smaller one"
                )
            case "fault":
                return InvalidPanoramaError("the panorama file is damaged: save it anew")
            case "queue-full":
                return OverloadedError(_QUEUE)
            case "not-ready":
                return DecoderNotReadyError()
            case "closing":
                return StoppingError()
            case "deadline" | "died":
                return DeadlineExceededError(self._settings.requests.request_deadline_s)
