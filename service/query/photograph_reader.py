"""Reader of a query's photographs: from files to photographs, and from photographs to encoded queries."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.localise.answers.documents import Spot
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, KnownHeading, Query
from lalaloc_core.localise.query.query import known_heading
from lalaloc_core.photograph import Photograph, StatedCamera
from lalaloc_core.photograph.film import Film
from lalaloc_core.photograph.photograph import Purpose
from lalaloc_core.photograph.turn_angles import TurnAngles
from service.decoding.decoder import Decoder
from service.query.executor import Executor
from service.query.queries import Content
from service.query_context import QueryContext
from service.uploaded_file import UploadedFile

# Photographs of a query that are decoded at the same time.
_BESIDE = 2


class PhotographReader:
    """Decoder, in worker processes, and encoder, on compute threads, of a query's photographs."""

    def __init__(
        self, decoder: Decoder, encoder: PhotographEncoder, executor: Executor, *, compass_tolerance_deg: float
    ) -> None:
        self._decoder, self._encoder, self._executor = decoder, encoder, executor
        self._compass_tolerance_deg = compass_tolerance_deg

    async def decode(
        self, contents: Sequence[Content], stated: StatedCamera, context: QueryContext
    ) -> list[Photograph]:
        """Decode photographs, in their order."""
        with context.clock.stage("decode"):
            return await self._decode_all(contents, stated, context)

    async def _decode_all(
        self, contents: Sequence[Content], stated: StatedCamera, context: QueryContext, *, purpose: Purpose = "single"
    ) -> list[Photograph]:
        """Decode photographs, a few at a time, so that a query leaves the other decoders to others."""

        async def decode(index: int) -> Photograph:
            with _named(index, contents):
                return await self._decoder.decode(contents[index], stated, context, purpose=purpose)

        photographs: list[Photograph] = []
        for first in range(0, len(contents), _BESIDE):
            group = range(first, min(first + _BESIDE, len(contents)))
            for decoded in await asyncio.gather(*map(decode, group), return_exceptions=True):
                if isinstance(decoded, BaseException):
                    raise decoded
                photographs.append(decoded)
        return photographs

    async def decode_turn(
        self, contents: Sequence[Content], stated: StatedCamera, context: QueryContext
    ) -> tuple[list[Photograph], list[TurnAngles] | None]:
        """Decode photographs of one spot, with the tilt, field of view and angles that their overlap tells.

        There are no angles if they are features, or a sphere is among them.
        """
        with context.clock.stage("decode"):
            photographs = await self._decode_all(contents, stated, context, purpose="turn")
            if any(photograph.overview is None for photograph in photographs):
                # Patches of the others are not cut yet.
                each = zip(photographs, contents, strict=True)
                return [
                    photograph if photograph.overview is None else await self._decoder.decode(content, stated, context)
                    for photograph, content in each
                ], None
            return await self._decoder.level_turn(photographs, context)

    async def film(self, content: bytes | UploadedFile, stated: StatedCamera, context: QueryContext) -> Film:
        """Read a film of a turn."""
        with context.clock.stage("decode"):
            return await self._decoder.film(content, stated, context)

    def known_heading(
        self, heading_deg: float | None, tolerance_deg: float, north: float | None, photograph: Photograph
    ) -> KnownHeading:
        """Return the heading in the request, else the photograph's compass heading if `north` is known, else none.

        `north` is the azimuth of true north (radians) in the plan.
        """
        compass = photograph.compass_heading
        return known_heading(north, heading_deg, tolerance_deg, compass, self._compass_tolerance_deg)

    async def encode(
        self,
        spots: Sequence[Spot],
        known: Sequence[KnownHeading],
        heights: Sequence[CameraHeight],
        context: QueryContext,
    ) -> list[Query]:
        """Encode photographs with their known headings one at a time, so that queries of others come in between."""
        with context.clock.stage("encode"):
            return [
                await self._executor.compute(context, partial(self._encode, spot, heading, height))
                for spot, heading, height in zip(spots, known, heights, strict=True)
            ]

    def _encode(self, spot: Spot, known: KnownHeading, height: CameraHeight) -> Query:
        return self._encoder.query(
            spot.photograph, known.heading, height, heading_tolerance=known.tolerance, others=spot.others
        )


@contextmanager
def _named(index: int, contents: Sequence[Content]) -> Iterator[None]:
    """Name the photograph in the message of a refusal, if there are several."""
    try:
        yield
    except InvalidPhotographError as error:
        if len(contents) == 1:
            raise
        raise type(error)(f"photo[{index}]: {error}") from error
