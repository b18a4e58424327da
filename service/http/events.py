"""Server-sent events about plans in preparation and albums that are solved, by this replica or another.

All streams share one task that polls the store, so the cost does not grow with their number.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import suppress
from contextvars import Context
from time import monotonic
from typing import Generic, TypeVar

from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from service.capacity.admission_control import Admission
from service.capacity.threads import BoundedReads
from service.errors import StoreUnavailableError
from service.grids import GridProvider
from service.schemas.albums import AlbumEvent
from service.schemas.stored_plans import PlanEvent
from service.settings import Settings
from service.storage import Store
from service.telemetry import LOGGER_NAME

_POLL_INTERVAL_S = 0.25
HEARTBEAT_S = 15.0
# Minimum interval at which a stream checks its API key.
_MIN_HEARTBEAT_S = 1.0
# Delay before a browser reconnects.
_RETRY_MS = 3000
# Timeout for sending the end of a stream to a slow reader.
_LAST_BYTES_S = 5.0
PLAN_ENDS = frozenset({"ready", "failed", "deleted"})
ALBUM_ENDS = frozenset({"solved", "failed", "outdated", "deleted"})


# The service itself, in the place of a tenant.
_SERVICE = ""

StillAuthorised = Callable[[], Awaitable[bool]]
EventT = TypeVar("EventT", PlanEvent, AlbumEvent)


class EventStream(StreamingResponse):
    """Stream that ends in bounded time, even if its client stops reading."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncGenerator[bytes], max_s: float) -> None:
        # Proxies must not buffer events.
        super().__init__(events, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._events, self._max_s = events, max_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the stream."""
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(self._max_s + _LAST_BYTES_S):
                    await super().__call__(scope, receive, send)
        finally:
            await self._events.aclose()


class ProgressEvents(Generic[EventT]):
    """Event streams about the progress of stored resources of one kind; for one event loop.

    `look` reads the state of resources by id, and leaves deleted ones out. A stream ends after a `final` state, `max_s`
    (s), or when the service stops; at every heartbeat its caller is checked.
    """

    def __init__(
        self,
        look: Callable[[set[str]], Mapping[str, EventT]],
        deleted: EventT,
        final: frozenset[str],
        admission: Admission,
        reads: BoundedReads,
        *,
        max_s: float,
        heartbeat_s: float,
    ) -> None:
        self._look, self._deleted, self._final, self._admission = look, deleted, final, admission
        self._reads, self._max_s, self._heartbeat_s = reads, max_s, heartbeat_s
        self._subscribers: set[_Subscriber[EventT]] = set()
        self._watch: asyncio.Task[None] | None = None

    def event_stream(self, resource_id: str, still_authorised: StillAuthorised) -> EventStream:
        """Return the stream of an existing resource; `still_authorised` is called at every heartbeat."""
        return EventStream(self.stream(resource_id, still_authorised), self._max_s)

    async def stream(self, resource_id: str, still_authorised: StillAuthorised) -> AsyncGenerator[bytes]:
        """Yield encoded events until the resource reaches a final state, the timeout passes, or the service stops."""
        subscriber = _Subscriber[EventT](resource_id)
        self._subscribers.add(subscriber)
        if self._watch is None or self._watch.done():
            # The task outlives this request, so it must not log under its ids.
            self._watch = asyncio.create_task(self._poll_all(), context=Context())
        try:
            yield f"retry: {_RETRY_MS}\n\n".encode()
            until = monotonic() + self._max_s
            check_at = monotonic() + self._heartbeat_s
            while (left_s := until - monotonic()) > 0.0 and not self._admission.stopping:
                if monotonic() >= check_at:
                    if not await still_authorised():
                        return
                    check_at = monotonic() + self._heartbeat_s
                try:
                    async with asyncio.timeout(min(left_s, self._heartbeat_s)):
                        event = await subscriber.next()
                except TimeoutError:
                    yield b": heartbeat\n\n"
                    continue
                if event is None:
                    return
                name = event.status if event.status in self._final else "progress"
                yield f"event: {name}\ndata: {event.model_dump_json(exclude_none=True)}\n\n".encode()
                if event.status in self._final:
                    return
        finally:
            self._subscribers.discard(subscriber)

    async def _poll_all(self) -> None:
        while self._subscribers:
            subscribers = list(self._subscribers)
            try:
                found = await self._reads.run(_SERVICE, self._look, {subscriber.id for subscriber in subscribers})
                for subscriber in subscribers:
                    subscriber.put(found.get(subscriber.id, self._deleted))
            except StoreUnavailableError:
                # Retried in the next round.
                pass
            except Exception:
                logging.getLogger(LOGGER_NAME).exception("reading states for event streams failed")
            if self._admission.stopping:
                for subscriber in list(self._subscribers):
                    subscriber.put(None)
            await asyncio.sleep(_POLL_INTERVAL_S)


class _Subscriber(Generic[EventT]):
    """Subscriber of one stream; a new event replaces an unsent one."""

    def __init__(self, resource_id: str) -> None:
        self.id = resource_id
        self._event: EventT | None = None
        self._changed = asyncio.Event()

    def put(self, event: EventT | None) -> None:
        """Set the next event; None ends the stream."""
        if event is None or event != self._event:
            self._event = event
            self._changed.set()

    async def next(self) -> EventT | None:
        await self._changed.wait()
        self._changed.clear()
        return self._event


def heartbeat_s(settings: Settings) -> float:
    """Return the interval (s) of heartbeats of a stream, at each of which its key is checked."""
    if not settings.access.api_keys:
        return HEARTBEAT_S
    return max(min(settings.access.key_cache_s, HEARTBEAT_S), _MIN_HEARTBEAT_S)


def plan_look(store: Store, grids: GridProvider, plan_ids: set[str]) -> dict[str, PlanEvent]:
    """Return the states of plans by id."""
    summaries = store.plans.summaries(plan_ids)
    return {
        summary.id: PlanEvent(
            status=state.status, progress=state.progress, revision=summary.revision_id, reason=state.reason
        )
        for summary, state in zip(summaries, grids.states(summaries), strict=True)
    }


def album_look(store: Store, model_sha256: str, album_ids: set[str]) -> dict[str, AlbumEvent]:
    """Return the states of albums by id, for the running model."""
    return {
        album.id: AlbumEvent(
            status=album.state(model_sha256),
            progress=album.progress,
            photographs=album.photographs,
            revision_number=album.number,
            solved_revision_number=album.solved_number,
        )
        for album in store.albums.by_ids(album_ids)
    }
