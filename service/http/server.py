"""The HTTP server around the app: bounded connections, and a stop that finishes what is in work.

Running the app under another ASGI server works as well; what stands here is then that server's to do.
"""

from __future__ import annotations

import asyncio
import math
import os
import socket
import threading
from time import monotonic
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.http.admission_control import Admission, AdmissionLimits
from service.http.descriptors import max_connections_of
from service.settings import Settings

# Heads of requests; larger ones get a 400.
_MAX_HEAD_BYTES = 16 * 1024
# Timeout for the head of a request, and for the rest of a refused body.
_HEAD_DEADLINE_S = 10.0
# Shares of the time for stopping: for requests in work, and then for connections to close. The rest is for workers,
# background threads and the store.
_FOR_REQUESTS, _FOR_CONNECTIONS = 0.6, 0.1


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How the app is served.

    Raises:
        ConfigError: the system allows too few file descriptors.
    """
    limits = AdmissionLimits.of(settings)
    # The server's own refusal is plain text; ours comes first.
    least = limits.requests + limits.reads + limits.streams + 1
    max_connections = max_connections_of(max(settings.requests.max_connections, least), settings)
    return uvicorn.Config(
        app,
        http=bounded_protocol(_HEAD_DEADLINE_S, max_connections),
        # Not another one where it happens to be installed, as with the extra `ray`.
        loop="asyncio",
        ws="none",
        log_level="warning",
        # Connections make room for others before; this is for when all of them have a request in work.
        limit_concurrency=max_connections + 1,
        # uvicorn would believe whoever connects from this machine what address they come from.
        proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,
        timeout_keep_alive=math.ceil(settings.requests.keep_alive_s),
        timeout_graceful_shutdown=math.ceil(_FOR_CONNECTIONS * settings.requests.stop_deadline_s),
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
    )


class Server(uvicorn.Server):
    """Stops in steps: it says so, then refuses requests while those in work are finished, then closes the listener."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, settings: Settings) -> None:
        super().__init__(config)
        self._app = app
        self._settings = settings
        self._stopping_since: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """The first signal begins to stop, the second ends the process; workers notice and follow."""
        if self._stopping_since is not None:
            os._exit(1)
        self._stopping_since = monotonic()
        # Whatever hangs, a thread or a disk, ends then.
        last_resort = threading.Timer(self._settings.requests.stop_deadline_s, os._exit, [1])
        last_resort.daemon = True
        last_resort.start()
        admission = self._admission
        if admission is None:
            self.should_exit = True
        elif self._settings.requests.stop_notice_s > 0.0:
            # Load balancers go on sending until they have noticed.
            admission.drain()
        else:
            admission.stop()

    async def on_tick(self, counter: int) -> bool:
        """Called ten times a second; true when it is time to close the listener."""
        ended = await super().on_tick(counter)
        if ended or self._stopping_since is None:
            return ended
        waited_s = monotonic() - self._stopping_since
        max_s = _FOR_REQUESTS * self._settings.requests.stop_deadline_s
        if waited_s < min(self._settings.requests.stop_notice_s, max_s):
            return False
        admission = self._admission
        if admission is None:
            return True
        admission.stop()
        return admission.idle or waited_s >= max_s

    @property
    def _admission(self) -> Admission | None:
        """None before the app has started."""
        return getattr(self._app.state, "admission", None)


def bounded_protocol(head_deadline_s: float, max_connections: int) -> type[asyncio.Protocol]:
    """HTTP/1.1 with a limit on what the server alone sees: connections, heads of requests, bodies of refused ones."""

    class BoundedProtocol(H11Protocol):
        """Ends a connection that is longer without a request in work than being idle and sending a head may take.

        Idle connections end earlier, by the server's own clock; but that stops with the first byte that comes.
        """

        _limit: asyncio.TimerHandle | None = None
        _idle_since = 0.0

        def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            super().connection_made(transport)
            _send_at_once(transport)
            self._idle_since = monotonic()
            self._make_room()
            self._watch()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._idle_since = monotonic()
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._unwatch()

        def _make_room(self) -> None:
            """End the connection that is idle for longest if there are too many: another one is in use."""
            if len(self.connections) <= max_connections:
                return
            idle = [one for one in self.connections if isinstance(one, BoundedProtocol) and not one._in_work]
            oldest = min(idle, key=lambda one: one._idle_since, default=self)
            if oldest is not self:
                # Its end is noted in the loop's next round; until then it must not be chosen once more.
                self.connections.discard(oldest)
                oldest.transport.abort()

        @property
        def _in_work(self) -> bool:
            cycle: Any = self.cycle
            return cycle is not None and not cycle.response_complete

        def _watch(self) -> None:
            if self._in_work:
                self._unwatch()
            elif self._limit is None:
                delay_s = self.timeout_keep_alive + head_deadline_s
                self._limit = self.loop.call_later(delay_s, self.transport.abort)

        def _unwatch(self) -> None:
            if self._limit is not None:
                self._limit.cancel()
                self._limit = None

    return BoundedProtocol


def _send_at_once(transport: asyncio.Transport) -> None:
    """Let the body of an answer not wait until its head is acknowledged, which clients put off by 40 ms.

    asyncio sees to that only where it made the listening socket itself.
    """
    connection = transport.get_extra_info("socket")
    if connection is not None and connection.family in (socket.AF_INET, socket.AF_INET6):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
