"""What the client for asyncio does with floor plans."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import aclosing

import httpx
from httpx_sse import EventSource

from lalaloc_client import operations, requests
from lalaloc_client.async_sender import AsyncSender
from lalaloc_client.errors import NotFoundError
from lalaloc_client.events import Followed, check_stream
from lalaloc_client.layout import Layout
from lalaloc_client.model import FloorPlan, FloorPlanSummary, PlanEvent
from lalaloc_client.requests import Covariance, Document


class AsyncPlanMethods(AsyncSender):
    """Methods of `AsyncClient` about floor plans."""

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

    async def layout(self, floorplan_id: str, *, revision: str | None = None) -> Layout:
        """See `Client.layout`."""
        request = requests.layout_request(floorplan_id, revision)
        return await self._run(operations.layout(request, self._patience))

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
