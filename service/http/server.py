"""HTTP server of the app, with bounded connections and a stop that finishes requests in progress.

The app also runs under other ASGI servers, which must then bound connections and stop by themselves.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import math
import os
import resource
import socket
import threading
from time import monotonic
from types import FrameType
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from lalaloc_core.errors import ConfigError
from service.capacity.admission_control import Admission, AdmissionLimits
from service.settings import Settings
from service.telemetry import LOGGER_NAME

# Heads of requests; larger ones get a 400.
_MAX_HEAD_BYTES = 16 * 1024
# Messages of WebSockets, and the fragments of one; a photograph is sent in several messages.
_MAX_MESSAGE_BYTES, _MAX_FRAGMENTS = 2**20, 1024
# Interval of pings, which find connections without a client.
_PING_INTERVAL_S = 20.0
# Timeout for the head of a request, and for the rest of a refused body.
_HEAD_DEADLINE_S = 10.0
# Time (s) per byte at which bodies of refused requests arrive, of all connections together. They are dropped, so that
# clients read the refusal; at the speed of a local network they would occupy the event loop.
_DROPPING_S = 5e-9
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
        ws=BoundedSocket,
        ws_max_size=_MAX_MESSAGE_BYTES,
        # Photographs are compressed already.
        ws_per_message_deflate=False,
        ws_ping_interval=_PING_INTERVAL_S,
        # The answer to a ping waits behind a photograph that is not read on.
        ws_ping_timeout=limits.deadline_s,
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

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the app; its modules and model are then never searched for garbage again, which takes 0.3 s."""
        await super().startup(sockets)
        gc.collect()
        gc.freeze()

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
    dropping = _Pace(_DROPPING_S)

    class BoundedProtocol(H11Protocol):
        """Protocol that ends connections without a request in progress after a while, and reads refused bodies slowly.

        The server's own keep-alive timer stops at the first byte of a head; this one does not.
        """

        _limit: asyncio.TimerHandle | None = None
        _pause: asyncio.TimerHandle | None = None
        _idle_since = 0.0
        _is_socket = False

        def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            super().connection_made(transport)
            _send_at_once(transport)
            self._idle_since = monotonic()
            self._make_room()
            self._watch()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            if self.conn.our_state is h11.DONE and self.conn.their_state is h11.SEND_BODY:
                self.transport.pause_reading()
                self._pause = self.loop.call_later(dropping.wait_s(len(data)), self.transport.resume_reading)
            self._watch()

        def handle_websocket_upgrade(self, event: h11.Request) -> None:
            super().handle_websocket_upgrade(event)
            self._is_socket = True

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._idle_since = monotonic()
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._unwatch()
            if self._pause is not None:
                self._pause.cancel()

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
            if self._in_work or self._is_socket:
                self._unwatch()
            elif self._limit is None:
                delay_s = self.timeout_keep_alive + head_deadline_s
                self._limit = self.loop.call_later(delay_s, self.transport.abort)

        def _unwatch(self) -> None:
            if self._limit is not None:
                self._limit.cancel()
                self._limit = None

    return BoundedProtocol


class _Pace:
    """Pace of bytes that arrive on several connections."""

    def __init__(self, byte_s: float) -> None:
        self._byte_s = byte_s
        self._free_at = 0.0

    def wait_s(self, count: int) -> float:
        """Return the time (s) until more bytes may arrive on a connection, after the next `count` ones."""
        now = monotonic()
        self._free_at = max(self._free_at, now) + count * self._byte_s
        return self._free_at - now


class BoundedSocket(WebSocketsSansIOProtocol):
    """WebSocket protocol that bounds the fragments of a message; their list would grow even if they are empty."""

    async def send(self, message: Any) -> None:
        """Send a message."""
        await super().send(message)
        if self.initial_response is not None and self.close_sent:
            # A refused handshake is complete, and no error.
            self.handshake_complete = True

    def handle_cont(self, event: Frame) -> None:
        """Add a fragment."""
        if len(self.frames) < _MAX_FRAGMENTS:
            super().handle_cont(event)
            return
        self.frames = []
        self.conn.fail(CloseCode.MESSAGE_TOO_BIG, f"a message has more than {_MAX_FRAGMENTS} fragments")
        self.handle_parser_exception()


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
