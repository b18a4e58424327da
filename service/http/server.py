"""HTTP server of the app, with bounded connections and a stop that finishes requests in progress.

`uvicorn service.app:app` bounds connections alike, and stops by itself. Other ASGI servers must do both.
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
from pathlib import Path
from time import monotonic
from types import FrameType

import uvicorn
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from lalaloc_core.errors import ConfigError
from service.capacity.admission_control import Admission
from service.http.http_protocol import bounded_protocol
from service.settings import Settings
from service.telemetry import LOGGER_NAME

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


def server_config(app: FastAPI, settings: Settings, certificate: Path | None = None) -> uvicorn.Config:
    """Return the server's configuration, with TLS by a file with a certificate and its key, if any."""
    config = uvicorn.Config(
        app,
        # Not uvloop, even if it is installed, as with the extra `ray`.
        loop="asyncio",
        ws="none",
        ssl_certfile=certificate,
        log_level="warning",
        # By default uvicorn trusts `X-Forwarded-For` of all clients on this machine.
        proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,
        timeout_graceful_shutdown=math.ceil(_FOR_CONNECTIONS * settings.requests.stop_deadline_s),
    )
    _bound(config, settings)
    return config


class ServedApp(FastAPI):
    """App that keeps the configuration of the uvicorn server that starts it, for `bound_uvicorn`."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, or the start of the app."""
        if scope["type"] == "lifespan":
            # The function is a method of uvicorn's object for the start, which has the configuration.
            self.state.server = getattr(getattr(receive, "__self__", None), "config", None)
        await super().__call__(scope, receive, send)


def bound_uvicorn(app: FastAPI, settings: Settings) -> None:
    """Bound connections of the server that starts the app, if it is `uvicorn service.app:app`."""
    config = getattr(app.state, "server", None)
    if isinstance(config, uvicorn.Config) and isinstance(config.http, str):
        # Uvicorn has loaded the classes that were named; it listens after the app has started.
        config.http_protocol_class = _bound(config, settings)


def _bound(config: uvicorn.Config, settings: Settings) -> type[asyncio.Protocol]:
    """Bound connections, heads and events; return the protocol."""
    # More than all slots, so that this service's refusals come before the server's own.
    least = settings.pending_limit + settings.requests.max_reads + settings.requests.max_streams + 1
    max_connections = max_connections_of(max(settings.requests.max_connections, least), settings)
    protocol = config.http = bounded_protocol(_HEAD_DEADLINE_S, max_connections)
    # Idle connections make room first; this applies if all of them have a request in progress.
    config.limit_concurrency = max_connections + 1
    config.timeout_keep_alive = math.ceil(settings.requests.keep_alive_s)
    return protocol


class Server(uvicorn.Server):
    """Server that stops in steps: announce the stop, refuse new requests, finish those in progress, close."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, settings: Settings) -> None:
        super().__init__(config)
        self._app, self._settings = app, settings
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
            admission.draining = True
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


def max_connections_of(wanted: int, settings: Settings) -> int:
    """Raise the limit of file descriptors, and return the number of connections that fit."""
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
