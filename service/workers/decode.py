"""The body of a decoding worker process: the only place of the service that opens pictures it was sent.

From the bytes of an upload to a `Panorama`, or to the `DecodeRefusal` of what is none; and, as that keeps the
interpreter busy for as long, from drawings to pixels. The rest is in `service.workers.process`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.panorama.images import Panorama, PanoramaLimits, open_panorama, warm_up
from service.workers.process import limit_memory, serve_jobs


@dataclass(frozen=True)
class DecodeJob:
    """An uploaded picture, and the size that its pixels are wanted in."""

    content: bytes
    height: int
    width: int


@dataclass(frozen=True)
class RasteriseJob:
    """A drawing that is wanted as PNG."""

    svg: str


@dataclass(frozen=True)
class DecodeRefusal:
    """Why a picture is no usable panorama."""

    reason: str


def run_decoder(connection: Connection, height: int, width: int, limits: PanoramaLimits, memory_bytes: int) -> None:
    """Answer uploads with panoramas, and drawings with their pixels.

    Args:
        height, width: of the usual panorama, to be warm for it.
        memory_bytes: what decoding may need, besides what the process has before its first picture.
    """
    serve_jobs(connection, lambda: _load(height, width, limits, memory_bytes))


def _load(
    height: int, width: int, limits: PanoramaLimits, memory_bytes: int
) -> Callable[[DecodeJob | RasteriseJob], Panorama | DecodeRefusal | bytes]:
    warm_up(height=height, width=width)
    limit_memory(memory_bytes)

    def work(job: DecodeJob | RasteriseJob) -> Panorama | DecodeRefusal | bytes:
        if isinstance(job, RasteriseJob):
            return rasterise(job.svg)
        try:
            return open_panorama(job.content, height=job.height, width=job.width, limits=limits)
        except InvalidPanoramaError as error:
            return DecodeRefusal(str(error))

    return work
