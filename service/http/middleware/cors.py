"""CORS: cross-origin requests of the pages that the settings allow."""

from __future__ import annotations

from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from service.security.permissions import NEEDED

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
