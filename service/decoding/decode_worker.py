"""Program of a decoding worker process, which opens uploaded photographs.

It turns an uploaded file into a `Photograph`, or a picture to be shown. It also finds the angles between photographs
and rasterises drawings, which keep the interpreter busy for as long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection

import cv2
import numpy as np

from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.photograph import PatchSize, Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.film import Film, FilmLimits, read_film
from lalaloc_core.photograph.photograph import Purpose, open_picture, warm_up
from lalaloc_core.photograph.picture_files import PhotographLimits
from lalaloc_core.photograph.turn_angles import TurnAngles
from lalaloc_core.photograph.turned import level_turn
from service.uploaded_file import UploadedFile
from service.workers.process import limit_memory, serve_jobs


@dataclass(frozen=True, kw_only=True)
class DecodeSizes:
    """Sizes of decoded photographs: height and width (pixels) of full spheres, patches of others; limits of films."""

    sphere: tuple[int, int]
    patch: PatchSize
    film: FilmLimits


@dataclass(frozen=True)
class DecodeJob:
    """Uploaded photograph to read for the encoders; the worker gets it as bytes."""

    content: bytes | UploadedFile
    stated: StatedCamera
    purpose: Purpose = "single"


@dataclass(frozen=True)
class FilmJob:
    """Uploaded film of a turn; the worker gets it as bytes."""

    content: bytes | UploadedFile
    stated: StatedCamera


@dataclass(frozen=True)
class TurnJob:
    """Photographs of one spot, decoded for a turn, whose angles to each other are to be found."""

    photographs: Sequence[Photograph]


@dataclass(frozen=True)
class LevelledTurn:
    """Photographs of one spot with their patches, and their angles."""

    photographs: list[Photograph]
    angles: list[TurnAngles]


@dataclass(frozen=True)
class ShowJob:
    """Uploaded photograph to decode as a picture to be shown, a full sphere levelled; sizes are width and height."""

    content: bytes | UploadedFile
    stated: StatedCamera
    is_sphere: bool
    max_size: tuple[int, int]


@dataclass(frozen=True)
class RasteriseJob:
    """Drawing to turn into a PNG file."""

    svg: str


Job = DecodeJob | FilmJob | TurnJob | ShowJob | RasteriseJob
Result = Photograph | Film | LevelledTurn | np.ndarray | bytes


def run_decoder(connection: Connection, sizes: DecodeSizes, limits: PhotographLimits, memory_bytes: int) -> None:
    """Run decoding and rasterising jobs until the pipe closes.

    `memory_bytes` limits decoding, besides what the process uses before its first picture.
    """
    serve_jobs(connection, lambda: _load(sizes, limits, memory_bytes))


def _load(sizes: DecodeSizes, limits: PhotographLimits, memory_bytes: int) -> Callable[[Job], Result]:
    # A worker stands for one core.
    cv2.setNumThreads(1)
    warm_up(sphere_size=sizes.sphere, patch_size=sizes.patch)
    limit_memory(memory_bytes)

    def work(job: Job) -> Result:
        if isinstance(job, RasteriseJob):
            return rasterise(job.svg)
        if isinstance(job, TurnJob):
            return LevelledTurn(*level_turn(job.photographs, sizes.patch))
        assert isinstance(job.content, bytes)
        if isinstance(job, FilmJob):
            return read_film(job.content, stated=job.stated, patch_size=sizes.patch, limits=sizes.film)
        if isinstance(job, DecodeJob):
            return open_photograph(
                job.content,
                sphere_size=sizes.sphere,
                stated=job.stated,
                patch_size=sizes.patch,
                limits=limits,
                purpose=job.purpose,
            )
        return _shown(job, job.content, limits)

    return work


def _shown(job: ShowJob, content: bytes, limits: PhotographLimits) -> np.ndarray:
    if not job.is_sphere:
        return open_picture(content, max_size=job.max_size, limits=limits)
    width, height = job.max_size
    view = open_photograph(content, sphere_size=(height, width), stated=job.stated, limits=limits)
    assert view.sphere is not None
    return view.sphere
