"""The client for asyncio: the methods of `Client`, which has their documentation, with `await`."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from contextlib import aclosing
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

import httpx
from httpx_sse import EventSource

from lalaloc_client import operations, requests, venue_requests
from lalaloc_client.connection import http_options, request_to_send
from lalaloc_client.errors import NotFoundError
from lalaloc_client.events import Followed, check_stream
from lalaloc_client.model import (
    FloorPlan,
    FloorPlanSummary,
    Localisation,
    PlanEvent,
    Readiness,
    SequenceLocalisation,
    Venue,
    VenueAnchor,
    VenuePlan,
)
from lalaloc_client.operations import Patience, Reply, Steps, Wait
from lalaloc_client.requests import (
    Covariance,
    Document,
    Picture,
    PictureFormat,
    QueryOptions,
    Refine,
    Request,
    SequenceRefine,
)
from lalaloc_client.retry import RetryPolicy
from lalaloc_client.venue_requests import Unchanged

if TYPE_CHECKING:
    from PIL.Image import Image

T = TypeVar("T")


class AsyncClient:
    """Asks a LaLaLoc service; close it, or use it in an `async with` block. For one event loop."""

    def __init__(
        self, base_url: str, *, api_key: str | None = None, timeout_s: float = 60.0, retry: RetryPolicy | None = None
    ) -> None:
        """See `Client`."""
        self._http = httpx.AsyncClient(**http_options(base_url, api_key, timeout_s))
        self._patience = Patience(retry or RetryPolicy())

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def upload_floorplan(
        self, document: Document, *, options: Mapping[str, object] | None = None, idempotency_key: str | None = None
    ) -> FloorPlan:
        """See `Client.upload_floorplan`."""
        request = await asyncio.to_thread(requests.upload_request, document, options, idempotency_key)
        return await self._run(operations.plan(request, self._patience))

    async def replace_floorplan(
        self,
        floorplan_id: str,
        document: Document,
        *,
        options: Mapping[str, object] | None = None,
        if_match: str | None = None,
    ) -> FloorPlan:
        """See `Client.replace_floorplan`."""
        request = await asyncio.to_thread(requests.replace_request, floorplan_id, document, options, if_match)
        return await self._run(operations.plan(request, self._patience))

    async def floorplan(self, floorplan_id: str) -> FloorPlan:
        """See `Client.floorplan`."""
        return await self._run(operations.plan(requests.plan_request(floorplan_id), self._patience))

    async def floorplans(self, name: str | None = None, *, page_size: int = 100) -> AsyncIterator[FloorPlanSummary]:
        """See `Client.floorplans`."""
        cursor = None
        while True:
            page = await self._run(operations.page(requests.page_request(name, page_size, cursor), self._patience))
            for summary in page.floorplans:
                yield summary
            cursor = page.next_cursor
            if cursor is None:
                return

    async def delete_floorplan(self, floorplan_id: str) -> None:
        """See `Client.delete_floorplan`."""
        await self._run(operations.delete(requests.delete_request(floorplan_id), self._patience))

    async def original(self, floorplan_id: str) -> bytes:
        """See `Client.original`."""
        return await self._run(operations.content(requests.original_request(floorplan_id), self._patience))

    async def preview(
        self,
        floorplan_id: str,
        *,
        x_m: float | None = None,
        y_m: float | None = None,
        heading_deg: float | None = None,
        covariance_m2: Covariance | None = None,
    ) -> str:
        """See `Client.preview`."""
        request = requests.preview_request(
            floorplan_id, x_m=x_m, y_m=y_m, heading_deg=heading_deg, covariance_m2=covariance_m2
        )
        return (await self._run(operations.content(request, self._patience))).decode()

    async def export(self, floorplan_id: str, file_format: str) -> bytes:
        """See `Client.export`."""
        return await self._run(operations.content(requests.export_request(floorplan_id, file_format), self._patience))

    async def mesh(self, floorplan_id: str) -> bytes:
        """See `Client.mesh`."""
        return await self._run(operations.content(requests.mesh_request(floorplan_id), self._patience))

    async def events(self, floorplan_id: str) -> AsyncIterator[PlanEvent]:
        """See `Client.events`."""
        request = requests.events_request(floorplan_id)
        followed = Followed()
        while not followed.over:
            try:
                response = await self._run(operations.stream(request, self._patience))
            except NotFoundError as error:
                yield followed.deleted(error)
                return
            async with aclosing(response):
                check_stream(response)
                try:
                    async for message in EventSource(response).aiter_sse():
                        if (event := followed.take(message)) is not None:
                            yield event
                except httpx.TransportError:
                    # As good as ended: what is missed comes first on the next one.
                    pass
            if not followed.over:
                await self._do(followed.pause())

    async def wait_until_ready(self, floorplan_id: str, *, timeout_s: float = 300.0) -> FloorPlan:
        """See `Client.wait_until_ready`."""
        return await self._run(operations.ready_plan(floorplan_id, timeout_s, self._patience))

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
    ) -> Localisation:
        """See `Client.localise`."""
        # On a thread: reading and encoding a picture takes a while.
        request = await asyncio.to_thread(
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
        )
        return await self._run(operations.localisation(request, self._patience))

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
        query = await asyncio.to_thread(
            requests.localise_request,
            floorplan_id,
            panorama,
            **asked,
        )
        request = requests.picture_request(query, picture, picture_format)
        return await self._run(operations.content(request, self._patience))

    async def make_venue(
        self,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        idempotency_key: str | None = None,
    ) -> Venue:
        """See `Client.make_venue`."""
        request = venue_requests.make_request(plans, name, anchor, idempotency_key)
        return await self._run(operations.venue(request, self._patience))

    async def replace_venue(
        self,
        venue_id: str,
        plans: Iterable[VenuePlan],
        *,
        name: str | None = None,
        anchor: VenueAnchor | None = None,
        if_match: str | None = None,
    ) -> Venue:
        """See `Client.replace_venue`."""
        request = venue_requests.replace_request(venue_id, plans, name, anchor, if_match)
        return await self._run(operations.venue(request, self._patience))

    async def change_venue(
        self,
        venue_id: str,
        *,
        name: str | None = None,
        anchor: VenueAnchor | Unchanged | None = "unchanged",
        plans: Iterable[VenuePlan] = (),
        remove: Sequence[str] = (),
        if_match: str | None = None,
    ) -> Venue:
        """See `Client.change_venue`."""
        request = venue_requests.change_request(
            venue_id, name=name, anchor=anchor, plans=plans, remove=remove, if_match=if_match
        )
        return await self._run(operations.venue(request, self._patience))

    async def venue(self, venue_id: str) -> Venue:
        """See `Client.venue`."""
        return await self._run(operations.venue(venue_requests.venue_request(venue_id), self._patience))

    async def venues(self, name: str | None = None, *, page_size: int = 100) -> AsyncIterator[Venue]:
        """See `Client.venues`."""
        cursor = None
        while True:
            request = venue_requests.page_request(name, page_size, cursor)
            page = await self._run(operations.venue_page(request, self._patience))
            for venue in page.venues:
                yield venue
            cursor = page.next_cursor
            if cursor is None:
                return

    async def venue_plans(
        self, venue_id: str, *, level: float | None = None, page_size: int = 100
    ) -> AsyncIterator[VenuePlan]:
        """See `Client.venue_plans`."""
        cursor = None
        while True:
            request = venue_requests.plans_request(venue_id, level, page_size, cursor)
            page = await self._run(operations.venue_plan_page(request, self._patience))
            for plan in page.plans:
                yield plan
            cursor = page.next_cursor
            if cursor is None:
                return

    async def delete_venue(self, venue_id: str) -> None:
        """See `Client.delete_venue`."""
        await self._run(operations.delete(venue_requests.delete_request(venue_id), self._patience))

    async def localise_in_venue(
        self,
        venue_id: str,
        panorama: bytes | str | os.PathLike[str] | Image,
        *,
        heading_deg: float | None = None,
        heading_tolerance_deg: float | None = None,
        camera_height_m: float | None = None,
        camera_height_std_m: float | None = None,
        strict: bool | None = None,
        refine: Refine | None = None,
        top_k: int | None = None,
    ) -> Localisation:
        """See `Client.localise_in_venue`."""
        # As in `localise`.
        request = await asyncio.to_thread(
            requests.localise_request,
            None,
            panorama,
            venue_id=venue_id,
            heading_deg=heading_deg,
            heading_tolerance_deg=heading_tolerance_deg,
            camera_height_m=camera_height_m,
            camera_height_std_m=camera_height_std_m,
            refine=refine,
            top_k=top_k,
            strict=strict,
        )
        return await self._run(operations.localisation(request, self._patience))

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
        request = await asyncio.to_thread(
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
        return await self._run(operations.sequence(request, self._patience))

    async def limits(self) -> Mapping[str, Any]:
        """See `Client.limits`."""
        return await self._run(operations.limits(self._patience))

    async def ready(self) -> Readiness:
        """See `Client.ready`."""
        return await self._run(operations.readiness(self._patience))

    async def _run(self, steps: Steps[T]) -> T:
        try:
            step = next(steps)
            while True:
                reply = await self._do(step)
                step = steps.send(reply)
        except StopIteration as done:
            return done.value

    async def _do(self, step: Request | Wait) -> Reply:
        if isinstance(step, Wait):
            await asyncio.sleep(step.duration_s)
            return Reply()
        try:
            response = await self._http.send(request_to_send(self._http, step), stream=step.streamed)
            if step.streamed and response.status_code not in step.answers:
                await response.aread()
            return Reply(response)
        except httpx.TransportError as error:
            return Reply(failure=error)
