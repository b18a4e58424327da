"""Program of a decoding worker process, which opens uploaded photographs.

It also copies photographs, finds the angles between them, and draws, which keep the interpreter busy for as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from lalaloc_core.draw.canvas import rasterise
from lalaloc_core.photograph import PatchSize, Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.film import Film, FilmLimits, read_film
from lalaloc_core.photograph.photograph import Purpose, open_picture, warm_up
from lalaloc_core.photograph.picture_files import PhotographLimits, jpeg
from lalaloc_core.photograph.placed_copy import Place, PlacedHead, placed_head
from lalaloc_core.photograph.turn_angles import TurnAngles
from lalaloc_core.photograph.turned import level_turn
from service.workers.process import limit_memory, serve_jobs


class DecodeJob(NamedTuple):
    """Method of `Decoding` to call, and its arguments; uploaded files arrive as bytes."""

    task: Literal["photograph", "film", "turn", "picture", "copy", "drawing", "report"]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, kw_only=True)
class Decoding:
    """Work on uploaded files and drawings, a method for each kind.

    Attributes:
        sphere, patch: height and width (pixels) of full spheres, and patches of other photographs.
    """

    sphere: tuple[int, int]
    patch: PatchSize
    limits: PhotographLimits
    film_limits: FilmLimits

    def photograph(self, content: bytes, stated: StatedCamera, purpose: Purpose) -> Photograph:
        """Read a photograph for the encoders."""
        return open_photograph(
            content, sphere_size=self.sphere, stated=stated, patch_size=self.patch, limits=self.limits, purpose=purpose
        )

    def film(self, content: bytes, stated: StatedCamera, threads: int) -> Film:
        """Read a film of a turn."""
        return read_film(
            content, stated=stated, patch_size=self.patch, limits=replace(self.film_limits, threads=threads)
        )

    def turn(self, photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[TurnAngles]]:
        """Return photographs of one spot with their patches, and their angles to each other."""
        return level_turn(photographs, self.patch)

    def picture(self, content: bytes, stated: StatedCamera, is_sphere: bool, max_size: tuple[int, int]) -> np.ndarray:
        """Decode a photograph as a picture to be shown within a width and height, a full sphere levelled."""
        if not is_sphere:
            return open_picture(content, max_size=max_size, limits=self.limits)
        width, height = max_size
        view = open_photograph(content, sphere_size=(height, width), stated=stated, limits=self.limits)
        assert view.sphere is not None
        return view.sphere

    def copy(self, content: bytes, place: Place, max_size: tuple[int, int]) -> tuple[PlacedHead, bytes]:
        """Return the beginning of a copy of a photograph with its place, and the picture within `max_size` as JPEG."""
        head = placed_head(content, place, self.limits)
        return head, jpeg(open_picture(content, max_size=max_size, limits=self.limits))

    def drawing(self, svg: str) -> bytes:
        """Turn a drawing into a PNG file."""
        return rasterise(svg)

    def report(self, pages: Callable[[], Iterable[str]], dpi: int) -> bytes:
        """Turn drawings into a PDF file."""
        # PDFium is loaded by the workers that need it.
        from lalaloc_core.draw.pdf import draw_pdf

        return draw_pdf(pages(), dpi)


def run_decoder(connection: Connection, decoding: Decoding, memory_bytes: int) -> None:
    """Run jobs until the pipe closes.

    `memory_bytes` limits decoding, besides what the process uses before its first picture.
    """
    serve_jobs(connection, lambda: _load(decoding, memory_bytes))


def _load(decoding: Decoding, memory_bytes: int) -> Callable[[DecodeJob], object]:
    # A worker stands for one core.
    cv2.setNumThreads(1)
    warm_up(sphere_size=decoding.sphere, patch_size=decoding.patch)
    limit_memory(memory_bytes)
    return lambda job: getattr(decoding, job.task)(*job.arguments)
