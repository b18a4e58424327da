"""Heads of requests and answers: double framing, HEAD, CORS, security headers."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit, urlunsplit

from starlette.datastructures import MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import MalformedRequestError
from service.http.problems import problem_answer
from service.security.permissions import NEEDED


class FramingMiddleware:
    """Middleware that answers 400 to a request with both body lengths, since a proxy can use either (RFC 9112, 6.1)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        both = {b"content-length", b"transfer-encoding"}
        if scope["type"] != "http" or not both <= {name for name, _ in scope["headers"]}:
            await self._app(scope, receive, send)
            return
        error = MalformedRequestError("the request has both Content-Length and Transfer-Encoding; send one of them")
        answer = problem_answer(Request(scope), error)
        # The end of the body is ambiguous, so bytes that follow must not be read as a request.
        answer.headers["Connection"] = "close"
        await answer(scope, receive, send)


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


# A test compares the table with the routes.
_METHODS = sorted({method for method, _ in NEEDED} | {"HEAD"})
_SENT = ("Authorization", "Content-Type", "Idempotency-Key", "If-Match", "If-None-Match", "X-Request-ID", "traceparent")
_ANSWERED = ("ETag", "Idempotency-Replayed", "Location", "Retry-After", "X-Request-ID")
_PREFLIGHT_KEPT_S = 600


class CorsMiddleware:
    """Framework's CORS middleware, with the origins in the running app's settings.

    Credentials are never allowed: keys are sent in a header, and there are no cookies.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._cors: tuple[frozenset[str], CORSMiddleware] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        origins: frozenset[str] = getattr(scope["app"].state, "cors_origins", frozenset())
        if scope["type"] != "http" or not origins:
            await self._app(scope, receive, send)
            return
        if self._cors is None or self._cors[0] != origins:
            self._cors = (
                origins,
                CORSMiddleware(
                    self._app,
                    allow_origins=sorted(origins),
                    allow_methods=_METHODS,
                    allow_headers=_SENT,
                    expose_headers=_ANSWERED,
                    max_age=_PREFLIGHT_KEPT_S,
                ),
            )
        await self._cors[1](scope, receive, send)


# Answers are data: nothing in them can run, load or be framed. The pages set their own policy.
_ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_ONE_YEAR_S = 365 * 24 * 3600


class SecurityHeadersMiddleware:
    """Middleware that adds missing security headers, and HSTS over https."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _ALWAYS.items():
                    headers.setdefault(name, value)
                if (target := headers.get("location")) is not None:
                    # Without the host, which the framework takes from the request and a client can forge.
                    headers["location"] = urlunsplit(urlsplit(target)._replace(scheme="", netloc=""))
                # The server takes the scheme from X-Forwarded-Proto of trusted proxies.
                if scope["scheme"] == "https":
                    headers.setdefault("Strict-Transport-Security", f"max-age={_ONE_YEAR_S}")
            await send(message)

        await self._app(scope, receive, send_with_headers if scope["type"] == "http" else send)
