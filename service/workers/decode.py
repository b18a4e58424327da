"""Program of a decoding worker process, which opens uploaded photographs.

It turns an uploaded file into a `Panorama` or a `DecodeRefusal`. It also rasterises drawings, which keeps the
interpreter busy for as long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.panorama.images import Panorama, PanoramaLimits, open_panorama, warm_up
from service.uploaded_file import UploadedFile
from service.workers.process import limit_memory, serve_jobs


@dataclass(frozen=True)
class DecodeJob:
    """Uploaded picture, and the size (pixels) of the panorama to return; the worker gets the picture as bytes."""

    content: bytes | UploadedFile
    height: int
    width: int


@dataclass(frozen=True)
class RasteriseJob:
    """Drawing to turn into a PNG file."""

    svg: str


@dataclass(frozen=True)
class DecodeRefusal:
    """Reason why a picture is not a usable panorama."""

    reason: str


def run_decoder(connection: Connection, height: int, width: int, limits: PanoramaLimits, memory_bytes: int) -> None:
    """Run decoding and rasterising jobs until the pipe closes.

    Args:
        connection: the worker's end of the pipe.
        height: usual height (pixels) of a panorama, for which the worker warms up.
        width: usual width (pixels).
        limits: limits of panorama files.
        memory_bytes: memory limit of decoding, besides what the process uses before its first picture.
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
            assert isinstance(job.content, bytes)
            return open_panorama(job.content, height=job.height, width=job.width, limits=limits)
        except InvalidPanoramaError as error:
            return DecodeRefusal(str(error))

    return work
