"""What the client for asyncio asks about panoramas."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Unpack

from lalaloc_client import operations, requests
from lalaloc_client.answers import GeoPoseAnswer, Localisation, SequenceLocalisation
from lalaloc_client.async_sender import AsyncSender
from lalaloc_client.requests import Picture, PictureFormat, QueryOptions, Refine, SequenceRefine

if TYPE_CHECKING:
    from PIL.Image import Image


class AsyncQueryMethods(AsyncSender):
    """Methods of `AsyncClient` about panoramas, see `QueryMethods`."""

    async def localise(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        near: Mapping[str, float] | None = None,
        radius_m: float | None = None,
        rooms: Sequence[str] | None = None,
        strict: bool | None = None,
        refine: Refine | None = None,
        top_k: int | None = None,
        posterior: bool = False,
    ) -> Localisation:
        """See `Client.localise`."""
        return await self._query(
            operations.localisation,
            requests.localise_request,
            floorplan_id,
            panorama,
            heading_deg=heading_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
            near=near,
            radius_m=radius_m,
            rooms=rooms,
            strict=strict,
            posterior=posterior,
        )

    async def answer(self, answer_id: str) -> Localisation:
        """See `Client.answer`."""
        return await self._run(operations.localisation(requests.answer_request(answer_id), self._patience))

    async def forget_answer(self, answer_id: str) -> None:
        """See `Client.forget_answer`."""
        await self._run(operations.delete(requests.answer_request(answer_id, "DELETE"), self._patience))

    async def picture(
        self,
        floorplan_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        picture: Picture = "both",
        *,
        picture_format: PictureFormat = "png",
        **asked: Unpack[QueryOptions],
    ) -> bytes:
        """See `Client.picture`."""
        return await self._query(
            operations.content, requests.drawn_request, floorplan_id, panorama, picture, picture_format, **asked
        )

    async def localise_in_venue(
        self,
        venue_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        level: float | None = None,
        **asked: Unpack[QueryOptions],
    ) -> Localisation:
        """See `Client.localise_in_venue`."""
        return await self._query(
            operations.localisation,
            requests.localise_request,
            None,
            panorama,
            venue_id=venue_id,
            level=level,
            **asked,
        )

    async def geopose(
        self,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        floorplan_id: str | None = None,
        venue_id: str | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        accuracy_m: float | None = None,
    ) -> GeoPoseAnswer:
        """See `Client.geopose`."""
        return await self._query(
            operations.geopose,
            requests.geopose_request,
            panorama,
            floorplan_id=floorplan_id,
            venue_id=venue_id,
            latitude=latitude,
            longitude=longitude,
            accuracy_m=accuracy_m,
        )

    async def localise_sequence(
        self,
        floorplan_id: str,
        panoramas: Sequence[bytes | str | os.PathLike[str] | Image],
        *,
        motions: Sequence[Mapping[str, float] | None] | None = None,
        headings_deg: Sequence[float | None] | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        refine: SequenceRefine | None = None,
        top_k: int | None = None,
    ) -> SequenceLocalisation:
        """See `Client.localise_sequence`."""
        return await self._query(
            operations.sequence,
            requests.sequence_request,
            floorplan_id,
            panoramas,
            motions=motions,
            headings_deg=headings_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
        )
