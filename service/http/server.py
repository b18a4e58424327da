"""HTTP server of the app, with bounded connections and a stop that finishes requests in progress.

The app also runs under other ASGI servers, which must then bound connections and stop by themselves.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import resource
import socket
import threading
from time import monotonic
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from lalaloc_core.errors import ConfigError
from service.http.admission_control import Admission, AdmissionLimits
from service.settings import Settings
from service.telemetry import LOGGER_NAME

# Heads of requests; larger ones get a 400.
_MAX_HEAD_BYTES = 16 * 1024
# Timeout for the head of a request, and for the rest of a refused body.
_HEAD_DEADLINE_S = 10.0
# Fractions of the stop deadline: for requests in progress, then for closing connections. The rest is for workers,
# threads and the store.
_FOR_REQUESTS, _FOR_CONNECTIONS = 0.6, 0.1
# Descriptors for pipes of workers, listeners, files of the model and of the interpreter.
_RESERVED_DESCRIPTORS = 192
# SQLite opens the database, its log and its index.
_PER_DATABASE_CONNECTION = 3
_MIN_CONNECTIONS = 16


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """Return the server's configuration.

    Raises:
        ConfigError: the system allows too few file descriptors.
    """
    limits = AdmissionLimits.from_settings(settings)
    # More than all slots, so that this service's refusals come before the server's own.
    least = limits.requests + limits.reads + limits.streams + 1
    max_connections = max_connections_of(max(settings.requests.max_connections, least), settings)
    return uvicorn.Config(
        app,
        http=bounded_protocol(_HEAD_DEADLINE_S, max_connections),
        # Not uvloop, even if it is installed, as with the extra `ray`.
        loop="asyncio",
        ws="none",
        log_level="warning",
        # Idle connections make room first; this applies if all of them have a request in progress.
        limit_concurrency=max_connections + 1,
        # By default uvicorn trusts `X-Forwarded-For` of all clients on this machine.
        proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,
        timeout_keep_alive=math.ceil(settings.requests.keep_alive_s),
        timeout_graceful_shutdown=math.ceil(_FOR_CONNECTIONS * settings.requests.stop_deadline_s),
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
    )


class Server(uvicorn.Server):
    """Server that stops in steps: announce the stop, refuse new requests, finish those in progress, close."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, settings: Settings) -> None:
        super().__init__(config)
        self._app = app
        self._settings = settings
        self._stopping_since: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop at the first signal; end the process at the second."""
        if self._stopping_since is not None:
            os._exit(1)
        self._stopping_since = monotonic()
        # This ends the process even if a thread or a disk hangs. The stop was asked for, and every commit is complete
        # or undone, so the status is 0. Worker processes end with this one.
        last_resort = threading.Timer(self._settings.requests.stop_deadline_s, os._exit, [0])
        last_resort.daemon = True
        last_resort.start()
        admission = self._admission
        if admission is None:
            self.should_exit = True
        elif self._settings.requests.stop_notice_s > 0.0:
            # Load balancers need time to react.
            admission.drain()
        else:
            admission.stop()

    async def on_tick(self, counter: int) -> bool:
        """Return True when it is time to close the listener; called ten times a second."""
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
        """Admission of the running app; None before it has started."""
        return getattr(self._app.state, "admission", None)


def bounded_protocol(head_deadline_s: float, max_connections: int) -> type[asyncio.Protocol]:
    """Return an HTTP/1.1 protocol that bounds connections, request heads and bodies of refused requests."""

    class BoundedProtocol(H11Protocol):
        """Protocol that ends a connection which has no request in progress for too long.

        The server's own keep-alive timer stops at the first byte of a head; this one does not.
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
            """Close the connection that is idle the longest if there are too many."""
            if len(self.connections) <= max_connections:
                return
            idle = [peer for peer in self.connections if isinstance(peer, BoundedProtocol) and not peer._in_work]
            oldest = min(idle, key=lambda peer: peer._idle_since, default=self)
            if oldest is not self:
                # Removed now, because its end is only noted in the loop's next round.
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
    """Disable Nagle's algorithm, which delays bodies by up to 40 ms.

    asyncio disables it only for listening sockets that it created itself.
    """
    connection = transport.get_extra_info("socket")
    if connection is not None and connection.family in (socket.AF_INET, socket.AF_INET6):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def max_connections_of(wanted: int, settings: Settings) -> int:
    """Raise the limit of file descriptors, and return the number of connections that fit.

    Args:
        wanted: desired number of connections.
        settings: settings of the service.

    Raises:
        ConfigError: the system allows too few descriptors.
    """
    reserved = _RESERVED_DESCRIPTORS + _PER_DATABASE_CONNECTION * settings.database.connections
    allowed = _raised_to(wanted + reserved)
    if allowed - reserved < _MIN_CONNECTIONS:
        raise ConfigError(
            f"the system allows {allowed} file descriptors; at least {reserved + _MIN_CONNECTIONS} are needed. Raise "
            "`ulimit -n`"
        )
    if allowed - reserved < wanted:
        fields = {"max_connections": allowed - reserved, "wanted": wanted, "descriptors": allowed}
        logging.getLogger(LOGGER_NAME).warning("fewer connections than set", extra={"fields": fields})
    return min(wanted, allowed - reserved)


def _raised_to(needed: int) -> int:
    """Raise the limit of file descriptors as far as needed and allowed, and return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return needed
    if soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return soft
