"""The client for asyncio: the methods of `Client`, which has their documentation, with `await`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lalaloc_client import operations
from lalaloc_client.answers import Readiness
from lalaloc_client.async_plan_methods import AsyncPlanMethods
from lalaloc_client.async_query_methods import AsyncQueryMethods
from lalaloc_client.async_venue_methods import AsyncVenueMethods


class AsyncClient(AsyncPlanMethods, AsyncQueryMethods, AsyncVenueMethods):
    """Asks a LaLaLoc service; close it, or use it in an `async with` block. For one event loop."""

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def limits(self) -> Mapping[str, Any]:
        """See `Client.limits`."""
        return await self._run(operations.limits(self._patience))

    async def ready(self) -> Readiness:
        """See `Client.ready`."""
        return await self._run(operations.readiness(self._patience))
