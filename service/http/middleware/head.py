"""HEAD requests: the answer to GET without its body."""

from __future__ import annotations

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class HeadMiddleware:
    """Middleware that handles HEAD as GET and drops the answer after its head."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        answered = False

        async def send_head(message: Message) -> None:
            nonlocal answered
            if message["type"] == "http.response.start":
                answered = True
                await send(message)
                await send({"type": "http.response.body", "body": b""})
                # An event stream would not end by itself.
                work.cancel()

        work = asyncio.ensure_future(self._app({**scope, "method": "GET"}, receive, send_head))
        try:
            await work
        except asyncio.CancelledError:
            if not answered:
                work.cancel()
                raise
