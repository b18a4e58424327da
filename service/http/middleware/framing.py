"""Refusal of requests with two body lengths."""

from __future__ import annotations

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import MalformedRequestError
from service.http.problems import problem_answer


class FramingMiddleware:
    """Middleware that answers 400 to a request with both body lengths, since a proxy can use either (RFC 9112, 6.1)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or not _framed_twice(scope):
            await self._app(scope, receive, send)
            return
        error = MalformedRequestError("the request has both Content-Length and Transfer-Encoding; send one of them")
        answer = problem_answer(Request(scope), error)
        # The end of the body is ambiguous, so bytes that follow must not be read as a request.
        answer.headers["Connection"] = "close"
        await answer(scope, receive, send)


def _framed_twice(scope: Scope) -> bool:
    return {b"content-length", b"transfer-encoding"} <= {name for name, _ in scope["headers"]}
