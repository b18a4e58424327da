"""What the client for asyncio does with venues."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Sequence

from lalaloc_client import operations, venue_requests
from lalaloc_client.async_sender import AsyncSender
from lalaloc_client.model import Venue, VenueAnchor, VenuePlan
from lalaloc_client.venue_requests import Unchanged


class AsyncVenueMethods(AsyncSender):
    """Methods of `AsyncClient` about venues."""

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
