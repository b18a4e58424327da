"""The HTTP server around the app."""

from __future__ import annotations

import asyncio
import socket
import threading

import httpx
from fastapi import FastAPI

from service.http.server import Server, bounded_protocol, server_config
from service.settings import Settings
from tests.service.conftest import wait_for


def test_the_body_of_an_answer_does_not_wait_for_its_head_to_be_acknowledged() -> None:
    no_delay: list[int] = []

    class Watched(bounded_protocol(5.0)):
        def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            super().connection_made(transport)
            connection = transport.get_extra_info("socket")
            no_delay.append(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))

    app, settings = FastAPI(), Settings()
    config = server_config(app, settings)
    config.http = Watched
    # As the command line does: of a socket made like this, asyncio does not see that it is one of TCP.
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = Server(config, app, settings)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: server.started)
            httpx.get(f"http://127.0.0.1:{listener.getsockname()[1]}/openapi.json").raise_for_status()
        finally:
            server.should_exit = True
            thread.join(30.0)
    assert no_delay == [1]
